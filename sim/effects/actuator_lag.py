"""First-order lag of the arm's actuators."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from splatbot.sim.effects.physics import MotorEffect

if TYPE_CHECKING:
    from splatbot.sim.world import Draft


class ActuatorLag(MotorEffect, cost="one activation state for each actuator"):
    """First-order lag of the arm's actuators: τ da/dt = u - a, with command u and activation a.

    The time constant τ [s] is ``robot.motors.lag`` of the scene. MuJoCo integrates the filter exactly
    (``dyntype="filterexact"``).
    """

    parameter = "lag"
    quantity = "lag"

    def describe(self, value: float) -> str:
        """Describe the parameter's effect in a reason."""
        return f"motors lag by {1e3 * value:g} ms"

    def build(self, draft: Draft) -> None:
        """Give each actuator of the arm MuJoCo's exact first-order filter."""
        motors = draft.scene.robot.motors if draft.scene.robot is not None else None
        if motors is None or motors.lag == 0:
            return
        for actuator in draft.spec.actuators:
            if actuator.name != "opening":
                actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
                actuator.dynprm[0] = motors.lag


EFFECT = ActuatorLag()
