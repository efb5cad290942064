"""An arm of Universal Robots through ur_rtde: set points of the certified curve at the rate of its controller."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np

from splatbot.errors import ControllerError, DeviceError, InputError
from splatbot.planning.certify import CertifiedMotion
from splatbot.protocols import RobotKinematics
from splatbot.robots.controllers.deviation import Deviation, between_set_points
from splatbot.robots.controllers.live import LiveController, LiveOptions, Measured

_JOINTS = 6
_LOOKAHEAD_S = (0.03, 0.2)  # ur_rtde, RTDEControlInterface.servoJ
_GAIN = (100.0, 2000.0)
_STOPS = {  # bits of the safety status (RTDE, safety_status_bits), the most specific first
    7: "emergency stop",
    2: "protective stop",
    4: "safeguard stop",
    8: "safety violation",
    9: "safety fault",
    10: "safety stop",
}
_RESTING = 0.01  # [rad/s] largest velocity of an arm at rest
_SETTLE_S = 1.0


class UrController(LiveController):
    """A :class:`splatbot.protocols.Controller` that streams ``servoJ`` commands; each step sends one.

    Between steps the arm holds the latest set point, so that a late caller delays the motion and never shortens it. A
    stop is ``servoStop`` and ``stopJ``: a joint with velocity v leaves the curve by at most ``v² / (2 deceleration)``.

    Args:
        host: address of the robot.
        robot: model of the arm, with the joints of ur_rtde: base, shoulder, elbow, wrists 1 to 3.
        frequency: rate of the set points [Hz]: 500 for e-Series, 125 for CB3.
        lookahead: time over which the robot smooths the set points [s], 0.03..0.2.
        gain: gain of the robot's position control, 100..2000.
        deceleration: of a stop [rad/s²].
        options: tolerances and times; ``update_rate`` has no effect.

    Raises:
        InputError: a value is out of range, or the robot has another number of joints.
        DeviceError: ur_rtde is not installed, or the robot does not answer.
    """

    def __init__(
        self,
        host: str,
        robot: RobotKinematics,
        *,
        frequency: float = 500.0,
        lookahead: float = 0.1,
        gain: float = 300.0,
        deceleration: float = 10.0,
        options: LiveOptions | None = None,
    ) -> None:
        if len(robot.chain) != _JOINTS:
            hint = "give a robot of Universal Robots, such as ur5e"
            raise InputError(f"has {len(robot.chain)} joints.", field=robot.name, hint=hint)
        for name, value, (low, high) in (
            ("frequency", frequency, (1.0, 500.0)),
            ("lookahead", lookahead, _LOOKAHEAD_S),
            ("gain", gain, _GAIN),
            ("deceleration", deceleration, (0.1, 40.0)),
        ):
            if not low <= value <= high:
                raise InputError(f"is {value}.", field=name, hint=f"give {low:g}..{high:g}")
        given = vars(options or LiveOptions()) | {"update_rate": frequency}
        super().__init__(robot, period=1.0 / frequency, options=LiveOptions(**given))
        self._lookahead, self._gain, self._deceleration = lookahead, gain, deceleration
        self._control, self._receive = _connect(host, frequency)
        self._stamp, self._stamped = -1.0, 0.0
        self._steps = 0
        self._commands = threading.RLock()  # no set point follows a stop
        try:
            self._at = self._measured()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the arm, and end the connections."""
        with suppress(ControllerError):
            self._abort()
        with suppress(ControllerError):
            self._call(self._control.stopScript)
        for interface in (self._control, self._receive):
            with suppress(ControllerError):
                self._call(interface.disconnect)

    def deviation(self, motion: CertifiedMotion) -> Deviation:
        """Bound the deviation of the set points and of their smoothing by the robot.

        The robot follows set points through a filter, which is not published. One of the first order is assumed. With
        the time constant τ, the lookahead, it deviates by at most ``τ²/2 max |q''|``, apart from a delay on the curve.
        """
        smoothing = between_set_points(motion.motion.pieces(), motion.arm.reach, 2.0 * self._lookahead)
        return super().deviation(motion) + smoothing

    def _may_move(self) -> bool:
        return self._steps > 0 and bool(np.abs(self._measured().velocity).max() > _RESTING)

    def _begin(self, motion: CertifiedMotion) -> None:
        self._check_states()
        self._steps = 0

    def _advance(self, motion: CertifiedMotion) -> float:
        self._check_states()
        if self._steps == 0:
            distance = float(np.abs(self._measured().position - motion.reference(0.0)[0]).max())
            if not distance <= self.options.start_tolerance:
                raise ControllerError(f"moved by {distance:.4f} before its motion began.", field="arm")
        self._steps += 1
        t = self._steps * self._period
        q = motion.reference(t)[0].tolist()
        begun = self._call(self._control.initPeriod)
        with self._commands:
            if self._stopping:
                return self._time
            # The second and the third argument, speed and acceleration, have no effect in ur_rtde.
            if not self._call(self._control.servoJ, q, 0.0, 0.0, self._period, self._lookahead, self._gain):
                raise ControllerError("was refused.", field="servoJ")
        self._call(self._control.waitPeriod, begun)
        return t

    def _arrived(self, motion: CertifiedMotion) -> bool:
        if self._time < motion.duration:
            return False
        at = self._measured()
        near = np.abs(at.position - motion.reference(motion.duration)[0]).max() <= self.options.goal_tolerance
        if not (near and np.abs(at.velocity).max() <= _RESTING):
            return False
        self._call(self._control.servoStop, self._deceleration)
        return True

    def _abort(self) -> None:
        """Stop servoing and brake; braking is tried although the first call fails."""
        if self._steps == 0:
            return
        with self._commands:
            try:
                self._call(self._control.servoStop, self._deceleration)
            finally:
                self._call(self._control.stopJ, self._deceleration)

    def _await_rest(self) -> None:
        if not self._wait(lambda: bool(np.abs(self._measured().velocity).max() <= _RESTING), self.options.stop_time):
            raise ControllerError(f"does not rest {self.options.stop_time:g} s after the stop.", field="arm")

    def _measured(self) -> Measured:
        position, velocity = (
            np.asarray(self._call(read), np.float64) for read in (self._receive.getActualQ, self._receive.getActualQd)
        )
        if position.shape != (_JOINTS,) or velocity.shape != (_JOINTS,):
            raise ControllerError("does not report its joints.", field="arm")
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            raise ControllerError("reports joints that are not finite.", field="arm")
        return Measured(position, velocity)

    def _resting(self) -> Measured:
        self._stamp = self._call(self._receive.getTimestamp)
        if not self._wait(lambda: self._age() == 0.0, self.options.max_age):
            raise ControllerError("does not report new states.", field="arm", hint="check the network and the robot")
        if not self._wait(lambda: bool(np.abs(self._measured().velocity).max() <= _RESTING), _SETTLE_S):
            raise ControllerError("moves.", field="arm", hint="wait until it rests")
        return self._measured()

    def _age(self) -> float:
        """Return the time since the robot's clock last advanced [s]."""
        stamp, now = self._call(self._receive.getTimestamp), time.monotonic()
        if stamp != self._stamp:
            self._stamp, self._stamped = stamp, now
        return now - self._stamped

    def _check_states(self) -> None:
        """Check that the robot answers, is not stopped, and runs the program of ur_rtde."""
        control, receive = self._control, self._receive
        if not (self._call(control.isConnected) and self._call(receive.isConnected)):
            raise ControllerError(
                "was lost.", field="connection", hint="check the network; the robot may stand or move"
            )
        safety = int(self._call(receive.getSafetyStatusBits))
        for bit, name in _STOPS.items():
            if safety >> bit & 1:
                raise ControllerError(f"{name}.", field="arm", hint="clear it on the teach pendant")
        if not self._call(control.isProgramRunning):
            hint = "switch the robot to remote control, and connect again"
            raise ControllerError("runs no program of ur_rtde.", field="arm", hint=hint)
        if self._age() > self.options.max_age:
            raise ControllerError(f"has not reported for {self._age():.2f} s.", field="arm")

    def _call(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call ur_rtde; each of its errors is a ControllerError."""
        try:
            return function(*args)
        except Exception as error:
            raise ControllerError(f"{error}.", field="ur_rtde", hint="check the robot and the network") from error


def _connect(host: str, frequency: float) -> tuple[Any, Any]:
    """Return the interfaces RTDEControlInterface and RTDEReceiveInterface of a robot."""
    try:
        control, receive = import_module("rtde_control"), import_module("rtde_receive")
    except ImportError as error:
        hint = 'pip install "splatbot[ur-rtde]"'
        raise DeviceError("ur_rtde is not installed.", field="robot", hint=hint) from error
    try:
        reads = receive.RTDEReceiveInterface(host, frequency)
        return control.RTDEControlInterface(host, frequency), reads
    except RuntimeError as error:
        hint = "check the address, and switch the robot to remote control"
        raise DeviceError(f"cannot be reached ({error}).", field=host, hint=hint) from error
