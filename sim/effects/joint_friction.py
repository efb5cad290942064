"""Joints stick a little: dry friction of bearings and gears."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft


class JointFriction(PhysicsEffect):
    """A row in the solver for each joint."""

    name = "joint_friction"
    cost = "a row in the solver for each joint"
    observable = "tracking_rms"

    def called_for(self, scene: Scene) -> str:
        """The scene gives it."""
        share = scene.robot.motors.friction if scene.robot is not None else 0.0
        return f"joints rub with {100 * share:g} % of their torque" if share > 0 else ""

    def not_called_for(self, scene: Scene) -> str:
        """There is none."""
        return "no friction of joints is given" if scene.robot is not None else "there is no robot"

    def build(self, draft: Draft) -> None:
        """``frictionloss`` of the arm's joints."""
        if draft.robot is None or draft.scene.robot is None:
            return
        share = draft.scene.robot.motors.friction
        for joint, effort in zip(draft.robot.chain.names, draft.robot.chain.effort, strict=True):
            draft.spec.joint(joint).frictionloss = share * float(effort)


EFFECT = JointFriction()
