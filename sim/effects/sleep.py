"""What lies still is not computed until something wakes it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft


class Sleep(PhysicsEffect):
    """MuJoCo's sleeping islands; saves time and costs the last millimetres of creep."""

    name = "sleep"
    cost = "less than nothing: it saves the steps of what rests"
    observable = "asleep"

    def called_for(self, scene: Scene) -> str:
        """Movable things will come to rest."""
        if scene.soft:  # a flex that sleeps wakes with stale elastic forces
            return ""
        if scene.medium is not None and any(scene.medium.wind):
            return ""
        return "movable things come to rest, and what rests need not be computed" if scene.movable else ""

    def not_called_for(self, scene: Scene) -> str:
        """Nothing can rest."""
        if scene.soft:
            return "soft bodies are to stay awake"
        return "in the wind nothing rests" if scene.movable else "there is nothing movable to rest"

    def build(self, draft: Draft) -> None:
        """MuJoCo's flag."""
        draft.spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)


EFFECT = Sleep()
