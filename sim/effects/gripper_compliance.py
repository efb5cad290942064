"""Fingers give way: their servo is a spring and their pads are rubber."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

_STIFF = 2000.0  # [N/m] of the servo where the scene gives none
_PAD_SOLREF = (0.005, 1.0)  # rubber: contacts that settle in 5 ms; slower ones let 70 N sink 7 mm into 50 g
_PAD_SOLIMP = (0.8, 0.95, 0.002, 0.5, 2.0)
_HOLDING = ("grasp", "hang", "squeeze")


class GripperCompliance(PhysicsEffect):
    """A softer servo and softer contacts of the fingers."""

    name = "gripper_compliance"
    cost = "nothing by itself; softer contacts overlap more"
    observable = "opening"

    def called_for(self, scene: Scene) -> str:
        """The task holds something, or the scene gives a stiffness."""
        if scene.robot is None:
            return ""
        if scene.robot.motors.finger_stiffness is not None:
            return f"the fingers' servo has {scene.robot.motors.finger_stiffness:g} N/m"
        if scene.task.kind in _HOLDING:
            return f"to {scene.task.kind} takes pads that give way"
        return ""

    def not_called_for(self, scene: Scene) -> str:
        """Nothing is held."""
        return "nothing is held" if scene.robot is not None else "there is no robot"

    def build(self, draft: Draft) -> None:
        """Rubber pads; the servo's gain."""
        if draft.robot is None or draft.robot.gripper is None or draft.scene.robot is None:
            return
        stiffness = draft.scene.robot.motors.finger_stiffness or _STIFF
        servo = draft.spec.actuator("opening")
        servo.gainprm[0], servo.biasprm[1] = stiffness, -stiffness
        for body in draft.robot_bodies:
            if body.name.startswith("finger"):
                for geom in body.geoms:
                    geom.solref, geom.solimp = list(_PAD_SOLREF), list(_PAD_SOLIMP)
                    geom.priority = 1


EFFECT = GripperCompliance()
