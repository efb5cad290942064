"""The twin as a controller with the same interface as that of a real arm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from splatbot.errors import InputError
from splatbot.protocols import Array, Feedback, MotionState, TimedPath
from splatbot.robots.controllers.base import CONSTANTS as CONTROLLER
from splatbot.robots.controllers.base import SteppedController
from splatbot.sim.gripper import TwinGripper
from splatbot.sim.twin import Twin


class TwinController(SteppedController):
    """A :class:`splatbot.protocols.Controller` whose arm is in a twin; each step is one control period of physics.
    Physics also runs while the arm holds still. After a stop the arm holds its position from the next step on.
    ``gripper`` controls its fingers, or equals None without a gripper.

        Args:
            twin: reset, or in any state.
            following: largest following error [rad or m], beyond which the controller faults.
            watch: called with MuJoCo's data and the time [s] after every control period; must not change the data.

        Raises:
            InputError: the twin has no robot.
    """

    def __init__(
        self,
        twin: Twin,
        *,
        following: float = CONTROLLER.max_tracking_error,
        watch: Callable[[Any, float], None] | None = None,
    ) -> None:
        if twin.follower is None:
            raise InputError("has no robot.", field=twin.scene.name, hint="give the scene a robot")
        self.twin, self._follower = twin, twin.follower
        has_fingers = twin.world.robot is not None and twin.world.robot.gripper is not None
        self.gripper = TwinGripper(twin) if has_fingers else None
        self._clock, self._watch = 0.0, watch
        super().__init__(self._measured(), period=1.0 / twin.rate, following=following)
        self._hold = self._position.copy()

    def send(self, motion: TimedPath) -> None:
        """Begin to follow a motion; see :class:`SteppedController`."""
        super().send(motion)
        self._before = motion.reference(0.0)[1]

    def step(self) -> Feedback:
        """Simulate one control period in any state of motion."""
        if self._state is MotionState.MOVING and not self._stopping:
            return super().step()
        if self._state is MotionState.MOVING:
            self._rest(MotionState.STOPPED)
        still = np.zeros_like(self._hold)
        self._advance(self._hold, still, still)
        self._position = self._measured()
        self._velocity = np.array(self.twin.data.qvel[self._follower.dofs])
        return Feedback(
            self._time, self._position.copy(), self._velocity.copy(), self._desired.copy(), self._state, self._fault
        )

    def _moved(self, t: float, desired: Array, velocity: Array) -> Array:
        acceleration = (velocity - self._before) / self._period
        self._before = velocity
        self._advance(desired, velocity, acceleration)
        return self._measured()

    def _rest(self, state: MotionState) -> None:
        super()._rest(state)
        self._hold = self._desired.copy() if state is MotionState.DONE else self._measured()

    def _advance(self, q: Array, velocity: Array, acceleration: Array) -> None:
        opening = None if self.gripper is None else self.gripper.command(self._period)
        self.twin.advance(self._clock, q, velocity, acceleration, opening)
        self._clock += self._period
        if self._watch is not None:
            self._watch(self.twin.data, self._clock)

    def _measured(self) -> Array:
        return np.array(self.twin.data.qpos[self._follower.qpos])
