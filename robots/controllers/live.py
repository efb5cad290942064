"""Base of controllers of real arms: checks before a motion, its clock, the tube around its curve, stops and faults."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from splatbot.collision import RobotSpheres
from splatbot.errors import ControllerError, InputError, SplatbotError
from splatbot.planning.certify import CONSTANTS as CERTIFICATION
from splatbot.planning.certify import CertifiedMotion, certify_motion
from splatbot.protocols import Array, Feedback, MotionState, RobotKinematics, TimedPath
from splatbot.robots.controllers.base import certified, check_start
from splatbot.robots.controllers.deviation import Deviation, between_set_points

_GRID_S = 0.01  # [s] spacing of the samples of the curve that a measured position is compared with


@dataclass(frozen=True)
class LiveOptions:
    """Tolerances and times of a real arm.

    Args:
        update_rate: rate of the set points that the drives receive [Hz]; between them they move straight.
        start_tolerance: largest distance of the arm from the start of a motion [rad or m].
        path_tolerance: largest distance of the arm from the curve [rad or m].
        goal_tolerance: largest distance from the end of the motion at which it is done [rad or m].
        goal_time: time after the end of the motion in which the arm may still arrive [s].
        lag: largest delay of the measured position behind the curve [s].
        max_age: largest age of a measured position [s].
        stop_time: time in which the arm must rest after a stop [s].

    Raises:
        InputError: a value is not above 0.
    """

    update_rate: float = 100.0
    start_tolerance: float = 0.01
    path_tolerance: float = 0.05
    goal_tolerance: float = 0.005
    goal_time: float = 1.0
    lag: float = 0.3
    max_age: float = 0.2
    stop_time: float = 3.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise InputError(f"is {value}.", field=name, hint="give a number above 0")


@dataclass(frozen=True, eq=False)
class Measured:
    """Measured state of an arm.

    Args:
        position, velocity: (J,) [rad or m, and per s].
    """

    position: Array
    velocity: Array


class LiveController:
    """A :class:`splatbot.protocols.Controller` of a real arm; a subclass speaks to it.

    A motion is sent only if the arm rests at its start and its limits hold for this robot. The executed motion may
    deviate from the certified curve by the certified clearance at most: the resolution of the certificate and the
    margin. During the motion the arm is stopped as soon as it leaves the tube around the curve.

    Args:
        robot: model of the arm; motions that were certified for another one are refused.
        period: control period [s].
        options: tolerances and times.

    Raises:
        InputError: the period is not above 0.
    """

    def __init__(self, robot: RobotKinematics, *, period: float, options: LiveOptions) -> None:
        if not 0.0 < period < np.inf:
            raise InputError(f"is {period}.", field="period", hint="give seconds above 0")
        self.robot, self.options, self._period = robot, options, period
        self._body = RobotSpheres(robot).without_pairs
        self._motion: CertifiedMotion | None = None
        self._at: Measured
        self._desired: Array | None = None
        self._curve: deque[Array] = deque(maxlen=int(np.ceil(options.lag / _GRID_S)) + 1)
        self._time = self._sampled = 0.0
        self._state, self._fault = MotionState.IDLE, ""
        self._stopping = False

    @property
    def period(self) -> float:
        """Control period [s]."""
        return self._period

    @property
    def state(self) -> MotionState:
        """State of the motion."""
        return self._state

    def deviation(self, motion: CertifiedMotion) -> Deviation:
        """Bound the deviation of the executed set points from a certified curve."""
        return between_set_points(motion.motion.pieces(), motion.arm.reach, 1.0 / self.options.update_rate)

    def send(self, motion: TimedPath) -> None:
        """Begin to follow a motion.

        Raises:
            ControllerError: the motion is not certified for this robot, exceeds a limit or begins elsewhere.
            ControllerError: the executed motion would deviate too far from the certified curve.
            ControllerError: the arm is at fault, moves, or does not report where it is.
        """
        motion = certified(motion, self._state, self._fault)
        self._check_motion(motion)
        check_start(motion.reference(0.0)[0], self._resting().position, self.options.start_tolerance)
        self._curve.clear()
        self._time = self._sampled = 0.0
        self._stopping = False
        try:
            self._begin(motion)
        except BaseException:
            with suppress(SplatbotError):
                self._abort()
            raise
        self._motion, self._state = motion, MotionState.MOVING
        if self._stopping:  # by another thread, while the motion was accepted
            self.stop()

    def step(self) -> Feedback:
        """Wait for the end of one period; after :meth:`stop`, until the arm rests.

        An arm at rest whose state is unknown is reported as a fault while this lasts.
        """
        problem, stopping = "", self._stopping
        if self._state is MotionState.MOVING and self._motion is not None:
            try:
                if stopping:
                    self._await_rest()
                    self._state = MotionState.STOPPED
                elif self._follow(self._motion):
                    self._state = MotionState.DONE
                self._at = self._measured()
            except SplatbotError as error:
                if stopping or not self._stopping:  # else the arm was stopped meanwhile: the next step waits for it
                    self._fail(error)
        else:
            self._pass_period()
            problem = self._look()
        at, state = self._at, MotionState.FAULT if problem else self._state
        desired = at.position if self._desired is None else self._desired
        return Feedback(self._time, at.position, at.velocity, desired, state, problem or self._fault)

    def stop(self) -> None:
        """Command a stop at once, in any state; the next step waits until the arm rests."""
        self._stopping = True
        with suppress(SplatbotError):  # the next step reports a stop that the arm does not heed
            self._abort()

    def reset(self) -> None:
        """Clear a fault, unless the arm may still move; the next motion is refused while its cause remains."""
        if not self._may_move():
            self._state, self._fault = MotionState.IDLE, ""

    def _check_motion(self, motion: CertifiedMotion) -> None:
        if motion.arm.robot.name != self.robot.name:
            text = f"is certified for {motion.arm.robot.name}, the arm is a {self.robot.name}."
            raise ControllerError(text, field="motion", hint=f"plan for {self.robot.name}")
        certify_motion(motion.motion, self._body, None)  # the limits of this robot, once more
        deviation, margin = self.deviation(motion), motion.arm.margin
        if not deviation.sphere <= CERTIFICATION.eps + margin:
            most = 1e3 * deviation.sphere
            text = f"moves the arm up to {most:.3f} mm ({deviation.joint:.1e} rad) away from its curve."
            hint = f"plan with a margin of {most:.2f} mm or more, slow the motion, or raise update_rate"
            raise ControllerError(text, field="motion", hint=hint)

    def _follow(self, motion: CertifiedMotion) -> bool:
        """Follow a motion for one period; return whether the arm has arrived."""
        self._time = t = self._advance(motion)
        self._desired = motion.reference(t)[0]
        while self._sampled <= t:
            self._curve.append(motion.reference(self._sampled)[0])
            self._sampled += _GRID_S
        at = self._measured().position
        distance = float(np.abs(np.stack([*self._curve, self._desired]) - at).max(axis=1).min())
        if not distance <= self.options.path_tolerance:
            raise ControllerError(f"is {distance:.4f} from the curve at {t:.3f} s.", field="arm")
        if self._arrived(motion):
            return True
        if t > motion.duration + self.options.lag + self.options.goal_time:
            raise ControllerError(f"has not arrived after {t:.3f} s.", field="arm")
        return False

    def _look(self) -> str:
        """Measure the state of an arm that does not follow a motion; return why it is unknown, or nothing."""
        try:
            self._check_states()
            self._at = self._measured()
        except SplatbotError as error:
            return _reason(error)
        return ""

    def _fail(self, error: SplatbotError) -> None:
        self._state, self._fault = MotionState.FAULT, _reason(error)
        with suppress(SplatbotError):
            self._abort()

    def _wait(self, found: Callable[[], bool], timeout_s: float) -> bool:
        """Return whether ``found`` becomes true within a time [s]."""
        deadline = time.monotonic() + timeout_s
        while not found():
            if time.monotonic() > deadline:
                return False
            time.sleep(min(0.002, self._period))
        return True

    def _may_move(self) -> bool:
        """Return whether a commanded motion may still run."""
        raise NotImplementedError

    def _begin(self, motion: CertifiedMotion) -> None:
        """Command a motion, or raise a ControllerError."""
        raise NotImplementedError

    def _advance(self, motion: CertifiedMotion) -> float:
        """Let one period pass and return the time since the start [s]; raise a ControllerError at a fault."""
        raise NotImplementedError

    def _arrived(self, motion: CertifiedMotion) -> bool:
        raise NotImplementedError

    def _abort(self) -> None:
        """Command the arm to stop, without waiting."""
        raise NotImplementedError

    def _await_rest(self) -> None:
        """Wait until a stopped arm rests, or raise a ControllerError."""
        raise NotImplementedError

    def _check_states(self) -> None:
        """Check that states of the arm arrive, or raise a ControllerError."""
        raise NotImplementedError

    def _measured(self) -> Measured:
        """Return the latest measured state, which may be old."""
        raise NotImplementedError

    def _resting(self) -> Measured:
        """Return the measured state of the arm at rest; raise a ControllerError if it is old or the arm moves."""
        raise NotImplementedError

    def _pass_period(self) -> None:
        time.sleep(self._period)


def _reason(error: SplatbotError) -> str:
    return f"{error.field}: {error.message}".rstrip(".")
