"""Sleeping of bodies at rest, which MuJoCo does not simulate until they are disturbed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft


class Sleep(PhysicsEffect):
    """MuJoCo's sleeping islands (``mjENBL_SLEEP``): bodies at rest are skipped until a contact or force wakes them.

    It saves time, and suppresses the last millimetres of creep.
    """

    name = "sleep"
    cost = "negative: bodies at rest are skipped"
    observable = "asleep"

    def reason_on(self, scene: Scene) -> str:
        """Return a reason if movable objects come to rest."""
        if scene.soft:  # a flex that wakes up has stale elastic forces
            return ""
        if scene.medium is not None and any(scene.medium.wind):
            return ""
        return "movable objects come to rest, and bodies at rest can be skipped" if scene.movable else ""

    def reason_off(self, scene: Scene) -> str:
        """Return a reason if no body can come to rest."""
        if scene.soft:
            return "soft bodies must stay awake"
        return "in wind no body comes to rest" if scene.movable else "there is no movable object"

    def build(self, draft: Draft) -> None:
        """Set MuJoCo's flag."""
        draft.spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)


EFFECT = Sleep()
