"""Dry friction of the joints' bearings and gears."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import MotorEffect

if TYPE_CHECKING:
    from splatbot.sim.world import Draft


class JointFriction(MotorEffect, cost="one solver row for each joint"):
    """Coulomb friction of each joint, by MuJoCo's ``frictionloss`` [N m].

    The friction is ``robot.motors.friction``, a fraction of the joint's maximum torque.
    """

    parameter = "friction"
    quantity = "joint friction"

    def describe(self, value: float) -> str:
        """Describe the parameter's effect in a reason."""
        return f"joints have friction of {100 * value:g} % of their torque"

    def build(self, draft: Draft) -> None:
        """Set ``frictionloss`` of the arm's joints."""
        if draft.robot is None or draft.scene.robot is None:
            return
        share = draft.scene.robot.motors.friction
        for joint, effort in zip(draft.robot.chain.names, draft.robot.chain.effort, strict=True):
            draft.spec.joint(joint).frictionloss = share * float(effort)


EFFECT = JointFriction()
