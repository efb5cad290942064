"""Driver of grippers with one Feetech STS servo, as the hands of SO-100 and SO-101; any error stops the jaw."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Literal

from splatbot.errors import GripperError, InputError
from splatbot.robots.grippers.checks import check_move
from splatbot.robots.grippers.errors import FaultError
from splatbot.robots.grippers.line import LineGripper, open_line
from splatbot.robots.grippers.scs import (
    BAUD,
    COMMAND,
    COUNTS,
    MEMORY,
    MODE,
    MODEL,
    MODELS,
    ServoClient,
    ServoCommand,
    ServoStatus,
)


@dataclass(frozen=True)
class FeetechConstants:
    """Constants of the communication with a servo.

    Args:
        poll_period: [s] time between two status requests that wait for the echo.
        echo_timeout: [s] time within which the memory must contain the command.
        start_time: [s] time within which the servo begins to move.
        tolerance: [counts] distance from the goal within which the jaw has reached it.
        speed: [counts/s] smallest and largest speed.
        torque: smallest and largest torque limit in per mille. Loads above 800 for 2 s trip the servo's protection.
        default_torque: torque limit of moves without a force, in per mille.
    """

    poll_period: float = 0.01
    echo_timeout: float = 0.5
    start_time: float = 0.1
    tolerance: int = 10
    speed: tuple[int, int] = (50, 3000)
    torque: tuple[int, int] = (100, 750)
    default_torque: int = 250


CONSTANTS = FeetechConstants()


@dataclass(frozen=True)
class JawCalibration:
    """Map between encoder counts and opening, measured on one gripper.

    A jaw on a pivot turns with the servo by the angle θ from the closed position. Its tip is at the distance
    2 L sin(θ/2) from the fixed jaw; L follows from the stroke. A linear map is for a rack, or a jaw on a parallelogram.

    Args:
        closed, opened: counts at the ends of the stroke, 0..4095; the jaw must not pass the encoder's zero.
        stroke: opening [m] at ``opened``.
        force: force of the tip [N] at the stall torque.
        shape: "pivot" or "linear".

    Raises:
        InputError: a value is out of range.
    """

    closed: int
    opened: int
    stroke: float
    force: float
    shape: Literal["pivot", "linear"] = "pivot"

    def __post_init__(self) -> None:
        if self.shape not in ("pivot", "linear"):
            raise InputError(f"is {self.shape!r}.", field="shape", hint="give pivot or linear")
        if not (0 <= self.closed < COUNTS and 0 <= self.opened < COUNTS):
            hint = f"give 0..{COUNTS - 1}; set the servo's middle position between the ends"
            raise InputError(f"are {self.closed}, {self.opened}.", field="closed, opened", hint=hint)
        most = COUNTS // 2 if self.shape == "pivot" else COUNTS
        if not 100 <= abs(self.opened - self.closed) < most:
            hint = f"give ends that are 100..{most - 1} counts apart"
            raise InputError(f"are {self.closed}, {self.opened}.", field="closed, opened", hint=hint)
        for name, value in (("stroke", self.stroke), ("force", self.force)):
            if not 0.0 < value < math.inf:
                raise InputError(f"is {value}.", field=name, hint="measure it; give a number above 0")

    def opening(self, count: int) -> float:
        """Convert counts to the opening [m], within 0 and the stroke."""
        share = min(max((count - self.closed) / (self.opened - self.closed), 0.0), 1.0)
        if self.shape == "linear":
            return self.stroke * share
        return self.stroke * math.sin(share * self._half) / math.sin(self._half)

    def count(self, opening: float) -> int:
        """Convert an opening [m] to counts."""
        share = opening / self.stroke
        if self.shape == "pivot":
            share = math.asin(share * math.sin(self._half)) / self._half
        return round(self.closed + share * (self.opened - self.closed))

    def count_speed(self, speed: float) -> float:
        """Convert a speed [m/s] to counts/s that exceed it nowhere; a jaw on a pivot is fastest where it is closed."""
        share = speed / self.stroke
        if self.shape == "pivot":
            share *= math.sin(self._half) / self._half
        return share * abs(self.opened - self.closed)

    @property
    def _half(self) -> float:
        """Half of the angle between the ends [rad]."""
        return math.pi * abs(self.opened - self.closed) / COUNTS


class FeetechGripper(LineGripper[ServoClient]):
    """A :class:`splatbot.protocols.Gripper` with one STS servo on a serial port, at 1 Mbit/s.

    Args:
        port: serial port, as "/dev/ttyACM0".
        jaw: its calibration.
        device: number of the servo; 6 is the hand of SO-100 and SO-101.
        hold_load: duty of the motor, as a fraction, from which a jaw at rest short of its goal holds an object.
        timeout: time-out of the header, and of the remaining bytes, of a response [s].
        retries: number of retries of an exchange.

    Raises:
        InputError: a value is out of range.
        LineError: the port cannot be opened.
    """

    def __init__(
        self,
        port: str,
        jaw: JawCalibration,
        *,
        device: int = 6,
        hold_load: float = 0.05,
        timeout: float = 0.1,
        retries: int = 4,
    ) -> None:
        if not 0 <= device <= 253:
            raise InputError(f"is {device}.", field="device", hint="give 0..253")
        least = CONSTANTS.torque[0] / 1000
        if not 0.0 < hold_load < least:
            hint = f"give a number above 0 and below {least:g}, the smallest torque limit"
            raise InputError(f"is {hold_load}.", field="hold_load", hint=hint)
        self.jaw, self._device, self._hold_load = jaw, device, hold_load
        self._sent: ServoCommand | None = None
        self._sent_at = -math.inf
        super().__init__(port, timeout=timeout, retries=retries)

    @property
    def stroke(self) -> float:
        """Widest opening [m]."""
        return self.jaw.stroke

    def activate(self) -> None:
        """Clear an overload, and switch the torque on at the present position.

        A lost port is opened again. A servo without a fault whose torque is on keeps its goal, and an object.

        Raises:
            GripperError: it is no STS servo in position mode, or its fault persists.
        """
        with self._secured():
            self._reopen()
            self._sent = None
            self._identify()
            status = self._read()
            if status.error:
                self._open_client.write(COMMAND, bytes([0]))  # clears an overload; the jaw yields for a moment
                status = self._status()
            if not status.command.enabled:
                self._write(ServoCommand(status.position, CONSTANTS.speed[0], CONSTANTS.default_torque))
                self._status()
            self._unsafe = ""

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        """Move to an opening [m], with at most a force [N] and a speed [m/s].

        The default is the largest speed and a quarter of the stall torque. Values outside the range of the servo are
        clamped. The force is the torque limit as a fraction of the force of the calibration. A jaw that meets an
        object stops and holds it.

        Raises:
            InputError: a value is out of range.
            GripperError: the gripper is not activated, or the command fails.
        """
        check_move(self.stroke, opening, force, speed)
        self._check_safe()
        slowest, fastest = CONSTANTS.speed
        rate = fastest if speed is None else min(max(int(self.jaw.count_speed(speed)), slowest), fastest)
        weakest, strongest = CONSTANTS.torque
        per_mille = CONSTANTS.default_torque if force is None else int(min(1000 * force / self.jaw.force, 1000))
        with self._secured():
            self._write(ServoCommand(self.jaw.count(opening), rate, min(max(per_mille, weakest), strongest)))

    def status(self) -> ServoStatus:
        """Read the status that refers to the last command.

        Raises:
            FaultError: the servo reports a fault.
            GripperError: the servo does not respond, or executes another command.
        """
        with self._secured():
            return self._status()

    def opening(self) -> float:
        """Return the distance between the fingers [m]."""
        return self.jaw.opening(self.status().position)

    def holds(self) -> bool:
        """Return whether an object stops the jaw: it rests short of its goal, under load."""
        status = self.status()
        if self._turns(status) or self._there(status):
            return False
        return abs(status.load) >= 1000 * self._hold_load

    def stop(self) -> None:
        """Keep the present position; a jaw that an object stops keeps its goal, so that the object stays grasped.

        Raises:
            GripperError: the command fails.
        """
        with self._secured():
            status = self._read()
            if self._turns(status):
                self._write(replace(self._sent or status.command, goal=status.position))
                self._status()

    def release(self) -> None:
        """Switch the torque off, so that the jaw moves by hand; activation is required afterwards.

        Raises:
            GripperError: the command fails.
        """
        with self._secured():
            self._sent, self._unsafe = None, "its torque was switched off"
            self._open_client.write(COMMAND, bytes([0]))

    def _opened(self) -> ServoClient:
        return ServoClient(open_line(self._port, baud=BAUD, timeout=self._timeout), self._device, retries=self._retries)

    def _identify(self) -> None:
        data = self._open_client.read(MODEL, MODE - MODEL + 1)
        model, mode = int.from_bytes(data[:2], "little"), data[-1]
        if model not in MODELS:
            hint = f"models: {', '.join(f'{name} ({number})' for number, name in MODELS.items())}"
            raise GripperError(f"is a servo of model {model}.", field=self._port, hint=hint)
        if mode != 0:
            hint = "set its operating mode to 0 with Feetech's program"
            raise GripperError(f"is in operating mode {mode}.", field=self._port, hint=hint)

    def _write(self, command: ServoCommand) -> None:
        self._sent, self._sent_at = command, time.monotonic()
        self._open_client.write(COMMAND, command.to_bytes())

    def _read(self, *, retries: int | None = None) -> ServoStatus:
        return ServoStatus.from_bytes(self._open_client.read(COMMAND, MEMORY - COMMAND, retries=retries))

    def _status(self) -> ServoStatus:
        """Read the status until the memory contains the last command; a servo that restarted has lost it."""
        until = time.monotonic() + CONSTANTS.echo_timeout
        while True:
            status = self._read()
            if status.error:
                raise FaultError(status.error, status.fault_text, field=self._port)
            if self._sent is None or status.command == self._sent:
                return status
            if time.monotonic() > until:
                hint = "check its supply, and that nothing else commands it; activate it"
                raise GripperError("does not execute the last command.", field=self._port, hint=hint)
            time.sleep(CONSTANTS.poll_period)

    def _there(self, status: ServoStatus) -> bool:
        return abs(status.position - status.command.goal) <= CONSTANTS.tolerance

    def _turns(self, status: ServoStatus) -> bool:
        """Return whether the jaw moves, or has just been commanded to."""
        begins = time.monotonic() - self._sent_at < CONSTANTS.start_time and not self._there(status)
        return status.command.enabled and (status.moving or begins)

    def _moves(self) -> bool:
        return self._turns(self._status())

    def _halt(self, client: ServoClient) -> None:
        status = self._read(retries=0)
        if self._turns(status):
            self._sent = replace(self._sent or status.command, goal=status.position)
            client.write(COMMAND, self._sent.to_bytes(), retries=0)
