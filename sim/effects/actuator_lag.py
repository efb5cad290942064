"""Motors follow their commands with a delay of first order."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft


class ActuatorLag(PhysicsEffect):
    """A low-pass filter before each motor of the arm, integrated exactly."""

    name = "actuator_lag"
    cost = "a state for each motor"
    observable = "tracking_rms"

    def called_for(self, scene: Scene) -> str:
        """The scene gives a time constant."""
        lag = scene.robot.motors.lag if scene.robot is not None else 0.0
        return f"motors lag by {1e3 * lag:g} ms" if lag > 0 else ""

    def not_called_for(self, scene: Scene) -> str:
        """There is none."""
        return "no lag is given" if scene.robot is not None else "there is no robot"

    def build(self, draft: Draft) -> None:
        """MuJoCo's exact filter."""
        motors = draft.scene.robot.motors if draft.scene.robot is not None else None
        if motors is None or motors.lag == 0:
            return
        for actuator in draft.spec.actuators:
            if actuator.name != "opening":
                actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
                actuator.dynprm[0] = motors.lag


EFFECT = ActuatorLag()
