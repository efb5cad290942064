"""Driver of Robotiq's 2F-85 and 2F-140 over Modbus RTU; any error stops the fingers."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from types import TracebackType

from splatbot.errors import GripperError, InputError
from splatbot.robots.grippers.checks import check_move
from splatbot.robots.grippers.modbus import LineError, ModbusClient, open_line
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
        poll_period: [s] time between two status requests.
        echo_timeout: [s] time within which the status must echo the commanded position.
    """

    poll_period: float = 0.01
    echo_timeout: float = 0.5


CONSTANTS = RobotiqConstants()


_log = logging.getLogger(__name__)


class FaultError(GripperError):
    """The gripper reports a fault, which ``status`` contains."""

    def __init__(self, status: Status, *, field: str) -> None:
        self.status = status
        super().__init__(f"reports fault {status.fault:#04x}: {status.fault_text}.", field=field, hint="activate it")


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


class RobotiqGripper(AbstractContextManager["RobotiqGripper"]):
    """A :class:`splatbot.protocols.Gripper` on a serial port.

    Every failure (no response, repeated wrong checksums, a lost port, a fault) raises
    :class:`splatbot.errors.GripperError`. The driver then sends one stop command and refuses moves until the gripper is
    activated again. No call lasts longer than its time-outs.

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
        if not 0.0 < timeout <= 10.0 or not 0 <= retries <= 100:
            raise InputError(f"are {timeout}, {retries}.", field="timeout, retries", hint="give seconds, and a number")
        self.model = MODELS[model]
        self._port, self._device, self._timeout, self._retries = port, device, timeout, retries
        self._unsafe = "it is not activated"
        self._sent: Command | None = None
        self._client: ModbusClient | None = self._opened()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    @property
    def stroke(self) -> float:
        """Widest opening [m]."""
        return self.model.stroke

    @property
    def unsafe(self) -> str:
        """Reason why moves are refused; empty if they are accepted."""
        return self._unsafe

    @property
    def repeated(self) -> int:
        """Number of repeated exchanges since the port was opened."""
        return self._client.repeated if self._client is not None else 0

    def activate(self, *, again: bool = False, patience: float = 10.0) -> None:
        """Clear faults and activate the gripper; the fingers close and open once.

        A lost port is opened again. An active gripper without a fault does not move, unless ``again`` is True.

        Raises:
            GripperError: it does not become ready within ``patience`` [s].
        """
        with self._secured():
            if self._client is None:
                self._client = self._opened()
            self._sent, self._unsafe = None, "it is not activated"
            status = self._read()
            if again or status.fault not in (0, NO_COMMUNICATION) or status.activation is not Activation.DONE:
                self._write(Command(activate=False, go=False))
                self._until(lambda s: not s.activated, patience, "does not reset", read=self._read)
                self._write(Command(go=False))
                self._until(lambda s: s.activation is Activation.DONE, patience, "is not ready")
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
        if self._unsafe:
            raise GripperError(f"takes no move: {self._unsafe}.", field=self._port, hint="activate it")
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

    def moving(self) -> bool:
        """Return whether the fingers move."""
        status = self.status()
        return status.going and status.fingers is Fingers.MOVING

    def opening(self) -> float:
        """Return the distance between the fingers [m]."""
        return self.model.opening(self.status().position)

    def holds(self) -> bool:
        """Return whether an object stops the fingers; after :meth:`stop` this is unknown, and False."""
        status = self.status()
        return status.going and status.fingers in (Fingers.STOPPED_CLOSING, Fingers.STOPPED_OPENING)

    def wait(self, seconds: float = 5.0) -> None:
        """Wait until the fingers stop.

        Raises:
            GripperError: they still move after ``seconds`` [s]; a stop command is then sent.
        """
        with self._secured():
            self._until(lambda s: not (s.going and s.fingers is Fingers.MOVING), seconds, "still moves")

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

    def close(self) -> None:
        """Close the port; a grasped object stays grasped."""
        if self._client is not None:
            self._client.close()
        self._client, self._unsafe = None, "its port is closed"

    def _opened(self) -> ModbusClient:
        return ModbusClient(open_line(self._port, timeout=self._timeout), self._device, retries=self._retries)

    @property
    def _open_client(self) -> ModbusClient:
        if self._client is None:
            raise LineError(f"is not open: {self._unsafe}.", file=self._port, hint="activate the gripper")
        return self._client

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
                raise FaultError(status, field=self._port)
            if self._sent is None or (status.requested, status.going) == (self._sent.position, self._sent.go):
                return status
            if time.monotonic() > until:
                hint = "check that nothing else commands it; activate it"
                raise GripperError("does not echo the last command.", field=self._port, hint=hint)
            time.sleep(CONSTANTS.poll_period)

    def _read(self) -> Status:
        return Status.from_bytes(self._open_client.read(STATUS, REGISTERS))

    def _until(
        self,
        holds: Callable[[Status], bool],
        seconds: float,
        failure: str,
        read: Callable[[], Status] | None = None,
    ) -> None:
        until = time.monotonic() + seconds
        while not holds((read or self._status)()):
            if time.monotonic() > until:
                raise GripperError(
                    f"{failure} after {seconds:g} s.", field=self._port, hint="check its power; activate it"
                )
            time.sleep(CONSTANTS.poll_period)

    @contextmanager
    def _secured(self) -> Iterator[None]:
        """Send one stop command after an error, and refuse later moves."""
        try:
            yield
        except GripperError as error:
            self._unsafe = self._unsafe or error.message.rstrip(".")
            _log.warning("%s", error)
            self._stand_still(lost=isinstance(error, LineError))
            raise

    def _stand_still(self, *, lost: bool) -> None:
        if self._client is None:
            return
        if not lost:
            try:
                self._client.write(COMMAND, replace(self._sent or Command(), go=False).to_bytes(), retries=0)
            except LineError:
                lost = True
            except GripperError as error:
                _log.warning("it may still move: %s", error)
        if lost:
            self._client.close()
            self._client = None


def _register(value: float | None, smallest: float, largest: float, *, default: int) -> int:
    """Map a value between the smallest and the largest to 0..255."""
    return default if value is None else round(255 * min(max((value - smallest) / (largest - smallest), 0.0), 1.0))
