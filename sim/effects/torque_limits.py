"""Limits of the motors' torques."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

_CONTACT_TASKS = ("grasp", "hang", "wipe", "squeeze")


class TorqueLimits(PhysicsEffect):
    """Actuator forces [N m], clamped to the limits of the robot's description."""

    name = "torque_limits"
    cost = "one clamp for each motor"
    observable = "overload"

    def reason_on(self, scene: Scene) -> str:
        """Return a reason if the task presses on an object, so that position errors would create large torques."""
        if scene.robot is not None and scene.task.kind in _CONTACT_TASKS:
            return f"to {scene.task.kind} creates contact forces, and motors stop at their limits"
        return ""

    def reason_off(self, scene: Scene) -> str:
        """Return a reason if the arm moves freely."""
        return "the task creates no contact forces" if scene.robot is not None else "there is no robot"

    def build(self, draft: Draft) -> None:
        """Enable the limits; their ranges are already in the specification."""
        for actuator in draft.spec.actuators:
            actuator.forcelimited = int(mujoco.mjtLimited.mjLIMITED_TRUE)


EFFECT = TorqueLimits()
