"""Sleeping of bodies at rest, which MuJoCo does not simulate until they are disturbed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft


class Sleep(PhysicsEffect, cost="negative: bodies at rest are skipped", observable="asleep"):
    """MuJoCo's sleeping islands (``mjENBL_SLEEP``): bodies at rest are skipped until a contact or force wakes them.

    It saves time, and suppresses the last millimetres of creep.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether movable objects come to rest, and why."""
        if scene.soft:  # a flex that wakes up has stale elastic forces
            return False, "soft bodies must stay awake"
        if not scene.movable:
            return False, "there is no movable object"
        if scene.medium is not None and any(scene.medium.wind):
            return False, "in wind no body comes to rest"
        return True, "movable objects come to rest, and bodies at rest can be skipped"

    def build(self, draft: Draft) -> None:
        """Set MuJoCo's flag."""
        draft.spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)


EFFECT = Sleep()
