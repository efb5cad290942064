"""Motors give no more than they can."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

_PRESSING = ("grasp", "hang", "wipe", "squeeze")


class TorqueLimits(PhysicsEffect):
    """Clamped motor forces: those of the robot's description."""

    name = "torque_limits"
    cost = "a clamp for each motor"
    observable = "overload"

    def called_for(self, scene: Scene) -> str:
        """The task presses on something, so that motors would push as hard as their error is large."""
        if scene.robot is not None and scene.task.kind in _PRESSING:
            return f"to {scene.task.kind} is to press, and motors stop at their limits"
        return ""

    def not_called_for(self, scene: Scene) -> str:
        """The arm moves freely."""
        return "the arm presses on nothing" if scene.robot is not None else "there is no robot"

    def build(self, draft: Draft) -> None:
        """The ranges are in the specification already."""
        for actuator in draft.spec.actuators:
            actuator.forcelimited = int(mujoco.mjtLimited.mjLIMITED_TRUE)


EFFECT = TorqueLimits()
