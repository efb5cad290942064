"""Limits of the motors' torques."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

_CONTACT_TASKS = ("grasp", "hang", "wipe", "squeeze")


class TorqueLimits(PhysicsEffect, cost="one clamp for each motor", observable="overload"):
    """Actuator forces [N m], clamped to the limits of the robot's description."""

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether the task presses on an object, so that position errors would create large torques, and why."""
        if scene.robot is None:
            return False, "there is no robot"
        if scene.task.kind not in _CONTACT_TASKS:
            return False, "the task creates no contact forces"
        return True, f"to {scene.task.kind} creates contact forces, and motors stop at their limits"

    def build(self, draft: Draft) -> None:
        """Enable the limits; their ranges are already in the specification."""
        for actuator in draft.spec.actuators:
            actuator.forcelimited = int(mujoco.mjtLimited.mjLIMITED_TRUE)


EFFECT = TorqueLimits()
