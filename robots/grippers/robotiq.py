"""Driver of Robotiq's 2F-85 and 2F-140 over Modbus RTU; any error stops the fingers."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace

from splatbot.errors import GripperError, InputError
from splatbot.robots.grippers.checks import check_move
from splatbot.robots.grippers.errors import FaultError
from splatbot.robots.grippers.line import LineGripper, open_line
from splatbot.robots.grippers.modbus import BAUD, ModbusClient
from splatbot.robots.grippers.registers import (
    COMMAND,
    NO_COMMUNICATION,
    REGISTERS,
    STATUS,
    Activation,
    Command,
    Fingers,
    Status,
)


@dataclass(frozen=True)
class RobotiqConstants:
    """Constants of the communication with a Robotiq gripper.

    Args:
        poll_period: [s] time between two status requests that wait for the echo.
        echo_timeout: [s] time within which the status must echo the commanded position.
    """

    poll_period: float = 0.01
    echo_timeout: float = 0.5


CONSTANTS = RobotiqConstants()


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Model:
    """Specification of a gripper (data sheets); force, speed and opening are linear in the registers.

    Args:
        stroke: widest opening [m].
        force: smallest and largest force [N].
        speed: smallest and largest speed of the opening [m/s].
        open_at, closed_at: gPO at the ends of the stroke; :meth:`RobotiqGripper.calibrate` measures them.
    """

    stroke: float
    force: tuple[float, float]
    speed: tuple[float, float]
    open_at: int = 13
    closed_at: int = 230

    def opening(self, position: int) -> float:
        """Convert gPO to the opening [m]."""
        share = (self.closed_at - position) / (self.closed_at - self.open_at)
        return self.stroke * min(max(share, 0.0), 1.0)

    def position(self, opening: float) -> int:
        """Convert an opening [m] to rPR; the ends of the stroke map to 255 and 0."""
        if opening <= 0.0:
            return 255
        if opening >= self.stroke:
            return 0
        return round(self.closed_at - opening / self.stroke * (self.closed_at - self.open_at))


MODELS = {
    "2f-85": Model(0.085, (20.0, 235.0), (0.02, 0.15)),
    "2f-140": Model(0.140, (10.0, 125.0), (0.03, 0.25)),
}


class RobotiqGripper(LineGripper[ModbusClient]):
    """A :class:`splatbot.protocols.Gripper` on a serial port.

    Args:
        port: serial port, as "/dev/ttyUSB0".
        model: "2f-85" or "2f-140".
        device: Modbus address.
        timeout: time-out of the first byte, and of the remaining bytes, of a response [s].
        retries: number of retries of an exchange.

    Raises:
        InputError: the model is unknown.
        LineError: the port cannot be opened.
    """

    def __init__(
        self, port: str, model: str = "2f-85", *, device: int = 9, timeout: float = 0.1, retries: int = 4
    ) -> None:
        if model not in MODELS:
            raise InputError(f"is {model!r}.", field="model", hint=f"models: {', '.join(MODELS)}")
        self.model, self._device = MODELS[model], device
        self._sent: Command | None = None
        super().__init__(port, timeout=timeout, retries=retries)

    @property
    def stroke(self) -> float:
        """Widest opening [m]."""
        return self.model.stroke

    def activate(self, *, again: bool = False, patience: float = 10.0) -> None:
        """Clear faults and activate the gripper; the fingers close and open once.

        A lost port is opened again. An active gripper without a fault does not move, unless ``again`` is True.

        Raises:
            GripperError: it does not become ready within ``patience`` [s].
        """
        with self._secured():
            self._reopen()
            self._sent = None
            status = self._read()
            if again or status.fault not in (0, NO_COMMUNICATION) or status.activation is not Activation.DONE:
                self._write(Command(activate=False, go=False))
                self._until(lambda: not self._read().activated, patience, "does not reset")
                self._write(Command(go=False))
                self._until(lambda: self._status().activation is Activation.DONE, patience, "is not ready")
            self._unsafe = ""

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        """Move to an opening [m], with at most a force [N] and a speed [m/s].

        The default is the largest speed and a quarter of the force range (the 2F-85: 74 N). Values outside the range of
        the gripper are clamped. Fingers that meet an object stop and hold it.

        Raises:
            InputError: a value is out of range.
            GripperError: the gripper is not activated, or the command fails.
        """
        check_move(self.stroke, opening, force, speed)
        self._check_safe()
        with self._secured():
            self._sent = Command(
                position=self.model.position(opening),
                speed=_register(speed, *self.model.speed, default=255),
                force=_register(force, *self.model.force, default=64),
            )
            self._write(self._sent)

    def status(self) -> Status:
        """Read the status that refers to the last command.

        Raises:
            FaultError: the gripper reports a fault.
            GripperError: the gripper does not respond.
        """
        with self._secured():
            return self._status()

    def opening(self) -> float:
        """Return the distance between the fingers [m]."""
        return self.model.opening(self.status().position)

    def holds(self) -> bool:
        """Return whether an object stops the fingers; after :meth:`stop` this is unknown, and False."""
        status = self.status()
        return status.going and status.fingers in (Fingers.STOPPED_CLOSING, Fingers.STOPPED_OPENING)

    def stop(self) -> None:
        """Stop the fingers; a grasped object stays grasped.

        Raises:
            GripperError: the command fails.
        """
        with self._secured():
            self._sent = replace(self._sent or Command(), go=False)
            self._write(self._sent)

    def release(self, *, opens: bool = True) -> None:
        """Open or close slowly, regardless of other commands (automatic release); activation is required afterwards.

        Raises:
            GripperError: the command fails.
        """
        with self._secured():
            self._unsafe = "it is in automatic release"
            self._write(Command(release=True, release_opens=opens))

    def calibrate(self, *, patience: float = 10.0) -> Model:
        """Close and open fully, without an object, and take the end positions as the ends of the stroke.

        Raises:
            GripperError: the end positions are implausible.
        """
        ends = []
        for opening in (0.0, self.stroke):
            self.move(opening)
            self.wait(patience)
            ends.append(self.status().position)
        closed, opened = ends
        if not opened + 128 <= closed:
            hint = "remove the object between the fingers"
            raise GripperError(f"closes at {closed} and opens at {opened}.", field=self._port, hint=hint)
        self.model = replace(self.model, open_at=opened, closed_at=closed)
        return self.model

    def _opened(self) -> ModbusClient:
        return ModbusClient(
            open_line(self._port, baud=BAUD, timeout=self._timeout), self._device, retries=self._retries
        )

    def _moves(self) -> bool:
        status = self._status()
        return status.going and status.fingers is Fingers.MOVING

    def _halt(self, client: ModbusClient) -> None:
        client.write(COMMAND, replace(self._sent or Command(), go=False).to_bytes(), retries=0)

    def _write(self, command: Command) -> None:
        self._open_client.write(COMMAND, command.to_bytes())

    def _status(self) -> Status:
        """Read the status until its echo matches the last command; an older status describes an earlier motion."""
        until = time.monotonic() + CONSTANTS.echo_timeout
        while True:
            status = self._read()
            if status.fault == NO_COMMUNICATION:
                _log.info("%s received no message for a second", self._port)
            elif status.fault:
                raise FaultError(status.fault, status.fault_text, field=self._port)
            if self._sent is None or (status.requested, status.going) == (self._sent.position, self._sent.go):
                return status
            if time.monotonic() > until:
                hint = "check that nothing else commands it; activate it"
                raise GripperError("does not echo the last command.", field=self._port, hint=hint)
            time.sleep(CONSTANTS.poll_period)

    def _read(self) -> Status:
        return Status.from_bytes(self._open_client.read(STATUS, REGISTERS))


def _register(value: float | None, smallest: float, largest: float, *, default: int) -> int:
    """Map a value between the smallest and the largest to 0..255."""
    return default if value is None else round(255 * min(max((value - smallest) / (largest - smallest), 0.0), 1.0))
