"""Base of controllers without hardware: the clock, checks of trajectories, stops and faults."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.errors import ControllerError, InputError
from splatbot.planning.certify import CertifiedMotion
from splatbot.protocols import Array, Feedback, MotionState, TimedPath


@dataclass(frozen=True)
class ControllerConstants:
    """Constants of controllers.

    Args:
        max_start_error: [rad or m] largest distance of the arm from the start of a trajectory that it accepts.
        max_tracking_error: [rad or m] largest tracking error before a fault.
    """

    max_start_error: float = 0.01
    max_tracking_error: float = 0.05


CONSTANTS = ControllerConstants()


def certified(motion: TimedPath, state: MotionState, fault: str) -> CertifiedMotion:
    """Return a motion that a controller in a state may begin.

    Raises:
        ControllerError: the motion is not certified, or the arm is at fault or moving.
    """
    if not isinstance(motion, CertifiedMotion):
        hint = "certify it with splatbot.planning.certify_motion"
        raise ControllerError(f"{type(motion).__name__} is not certified.", field="motion", hint=hint)
    if state is MotionState.FAULT:
        raise ControllerError(f"is at fault: {fault}.", field="controller", hint="reset it")
    if state is MotionState.MOVING:
        raise ControllerError("is moving.", field="controller", hint="stop it, or wait until it has arrived")
    return motion


def check_start(start: Array, position: Array, tolerance: float) -> None:
    """Check that a motion begins where the arm is: all joints (J,) within a tolerance [rad or m].

    Raises:
        ControllerError: it begins elsewhere.
    """
    distance = float(np.abs(start - position).max())
    if not distance <= tolerance:
        hint = "plan from where the arm is"
        raise ControllerError(f"begins {distance:.4f} from where the arm is.", field="motion", hint=hint)


class SteppedController:
    """A :class:`splatbot.protocols.Controller` whose motion a subclass defines.

    Args:
        position: (J,) position of the arm [rad or m].
        period: control period [s].
        following: largest tracking error before a fault [rad or m].

    Raises:
        InputError: the period or ``following`` is not above 0.
    """

    def __init__(
        self, position: Array, *, period: float = 1e-3, following: float = CONSTANTS.max_tracking_error
    ) -> None:
        if not (0.0 < period < np.inf and following > 0.0):
            raise InputError(f"is {period}.", field="period", hint="give seconds above 0, and a distance above 0")
        self._period, self._following = period, following
        self._position = np.array(position, dtype=np.float64)
        self._velocity = np.zeros_like(self._position)
        self._desired = self._position.copy()
        self._motion: TimedPath | None = None
        self._time = 0.0
        self._state, self._fault = MotionState.IDLE, ""
        self._stopping = False

    @property
    def period(self) -> float:
        """Control period [s]."""
        return self._period

    @property
    def position(self) -> Array:
        """Position (J,) of the arm [rad or m]."""
        return self._position.copy()

    @property
    def state(self) -> MotionState:
        """State of the motion."""
        return self._state

    def send(self, motion: TimedPath) -> None:
        """Begin to follow a motion.

        Raises:
            ControllerError: the motion is not certified, begins elsewhere, or the arm is at fault or moving.
        """
        start = certified(motion, self._state, self._fault).reference(0.0)[0]
        if start.shape != self._position.shape:
            raise ControllerError(f"has {start.size} joints, not {self._position.size}.", field="motion")
        check_start(start, self._position, CONSTANTS.max_start_error)
        self._motion, self._time, self._stopping = motion, 0.0, False
        self._state = MotionState.MOVING

    def step(self) -> Feedback:
        """Let one period pass."""
        if self._state is MotionState.MOVING and self._motion is not None:
            if self._stopping:
                self._rest(MotionState.STOPPED)
            else:
                self._follow(self._motion)
        return Feedback(
            self._time, self._position.copy(), self._velocity.copy(), self._desired.copy(), self._state, self._fault
        )

    def stop(self) -> None:
        """Stop at the next step."""
        self._stopping = True

    def fault(self, reason: str) -> None:
        """Stop until :meth:`reset`, as after an emergency stop."""
        self._rest(MotionState.FAULT)
        self._fault = reason

    def reset(self) -> None:
        """Clear a fault; the arm stays where it is."""
        self._rest(MotionState.IDLE)
        self._fault = ""

    def _follow(self, motion: TimedPath) -> None:
        self._time += self._period
        self._desired, velocity = motion.reference(self._time)
        position = self._moved(self._time, self._desired, velocity)
        self._velocity = (position - self._position) / self._period
        self._position = position
        error = float(np.abs(self._position - self._desired).max())
        if not error <= self._following:
            self.fault(f"{error:.4f} from the trajectory at {self._time:.3f} s")
        elif self._time >= motion.duration and error <= CONSTANTS.max_start_error:
            self._rest(MotionState.DONE)

    def _rest(self, state: MotionState) -> None:
        self._velocity = np.zeros_like(self._position)
        self._state, self._stopping = state, False

    def _moved(self, t: float, desired: Array, velocity: Array) -> Array:
        """Return the position (J,) of the arm at time ``t`` [s]."""
        raise NotImplementedError
