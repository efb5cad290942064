"""Compliance of the gripper: its servo acts as a spring, and its pads are rubber."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft


@dataclass(frozen=True)
class ComplianceConstants:
    """Constants of compliant fingers.

    Args:
        default_stiffness: [N/m] stiffness of the servo if the scene gives none.
        pad_solref: [s] time constant, and damping ratio; at 10 ms a force of 70 N sinks 7 mm into a 50 g object.
        pad_solimp: MuJoCo's impedance of the pads.
    """

    default_stiffness: float = 2000.0
    pad_solref: tuple[float, float] = (0.005, 1.0)
    pad_solimp: tuple[float, ...] = (0.8, 0.95, 0.002, 0.5, 2.0)


CONSTANTS = ComplianceConstants()


_GRASPING_TASKS = ("grasp", "hang", "squeeze")


class GripperCompliance(
    PhysicsEffect, cost="no additional computation; softer contacts have more overlap", observable="opening"
):
    """Softer finger servo and softer finger contacts.

    The servo is a spring of ``robot.motors.finger_stiffness`` [N/m]. The pads use MuJoCo's ``solref`` and ``solimp`` of
    rubber.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether the task grasps an object or the scene gives a stiffness, and why."""
        if scene.robot is None:
            return False, "there is no robot"
        if scene.robot.motors.finger_stiffness is not None:
            return True, f"the fingers' servo has {scene.robot.motors.finger_stiffness:g} N/m"
        if scene.task.kind in _GRASPING_TASKS:
            return True, f"to {scene.task.kind} requires compliant pads"
        return False, "the task grasps no object"

    def build(self, draft: Draft) -> None:
        """Set the contact parameters of the pads and the gain of the servo."""
        if draft.robot is None or draft.robot.gripper is None or draft.scene.robot is None:
            return
        stiffness = draft.scene.robot.motors.finger_stiffness or CONSTANTS.default_stiffness
        servo = draft.spec.actuator("opening")
        servo.gainprm[0], servo.biasprm[1] = stiffness, -stiffness
        for body in draft.robot_bodies:
            if body.name.startswith("finger"):
                for geom in body.geoms:
                    geom.solref, geom.solimp = list(CONSTANTS.pad_solref), list(CONSTANTS.pad_solimp)
                    geom.priority = 1


EFFECT = GripperCompliance()
