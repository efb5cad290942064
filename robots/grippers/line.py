"""Serial lines to grippers: exchanges with time-outs and retries, and grippers that stop after an error."""

from __future__ import annotations

import logging
import termios
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

import serial

from splatbot.errors import GripperError, InputError
from splatbot.robots.grippers.errors import LineError, NoAnswerError

QUIET = 0.004  # [s] of silence between frames; USB adapters hold bytes back longer than the lines need
_POLL = 0.01  # [s] between two status requests
_GONE = (serial.SerialException, OSError, termios.error)

_log = logging.getLogger(__name__)


class FramingError(Exception):
    """Bytes that are no frame; the exchange is worth another try."""


def open_line(port: str, *, baud: int, timeout: float) -> Any:
    """Open a serial port as 8N1 exclusively.

    Raises:
        LineError: it cannot be opened.
    """
    try:
        return serial.Serial(port, baud, timeout=timeout, write_timeout=timeout, exclusive=True)
    except (*_GONE, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise LineError(f"cannot be opened ({reason}).", file=port, hint=_ports()) from error


class LineClient:
    """Client of one device on a line. Every exchange ends within (retries + 1) · 4 time-outs.

    Args:
        line: an open ``serial.Serial`` with a time-out [s].
        device: number of the device.
        retries: number of tries after the first.
    """

    def __init__(self, line: Any, device: int, *, retries: int = 4) -> None:
        self._line, self._device, self._retries = line, device, retries
        self._lock = threading.Lock()  # one exchange at a time: a stop may come from another thread
        self.repeated = 0  # exchanges that were tried again

    def close(self) -> None:
        """Close the port, without an error if it is gone."""
        with self._lock:
            try:
                self._line.close()
            except _GONE as error:
                _log.debug("closing: %s", error)

    def _exchange(self, request: bytes, receive: Callable[[], bytes], retries: int | None = None) -> bytes:
        """Send a request and receive its response; repeat both after a FramingError.

        Raises:
            NoAnswerError, LineError: the exchange fails.
        """
        tries = 1 + (self._retries if retries is None else retries)
        reason = ""
        for k in range(tries):
            try:
                with self._lock:
                    return self._once(request, receive)
            except FramingError as error:
                reason = str(error)
                self.repeated += k + 1 < tries
                _log.info("try %d of %d got %s", k + 1, tries, reason)
                self._drain()
        hint = "check cable, power and the device's number; try a longer timeout"
        raise NoAnswerError(
            f"gave no good answer to {tries} tries; the last was {reason}.", field=self._name, hint=hint
        )

    def _once(self, request: bytes, receive: Callable[[], bytes]) -> bytes:
        try:
            self._line.reset_input_buffer()
            self._line.write(request)
            return receive()
        except serial.SerialTimeoutException as error:
            raise FramingError("a line that takes no bytes") from error
        except _GONE as error:
            raise self._gone(error) from error

    def _read(self, count: int) -> bytes:
        data = bytes(self._line.read(count))
        if len(data) < count:
            raise FramingError(f"{len(data)} of {count} bytes")
        return data

    def _drain(self) -> None:
        """Wait until the line is silent, at most one time-out, so that a late response is not read as the next one."""
        try:
            until = time.monotonic() + float(self._line.timeout)
            while time.monotonic() < until:
                time.sleep(QUIET)
                if not self._line.in_waiting:
                    return
                self._line.reset_input_buffer()
        except _GONE as error:
            raise self._gone(error) from error

    def _gone(self, error: BaseException) -> LineError:
        return LineError(f"is gone ({error}).", field=self._name, hint="plug it in again, then activate the gripper")

    @property
    def _name(self) -> str:
        return f"device {self._device} on {self._line.port}"


Client = TypeVar("Client", bound=LineClient)


class LineGripper(ABC, Generic[Client]):
    """Base of grippers on a serial port.

    Every failure (no response, repeated wrong checksums, a lost port, a fault) raises
    :class:`splatbot.errors.GripperError`. The driver then sends one stop command and refuses moves until the gripper is
    activated again. No call lasts longer than its time-outs.

    Args:
        port: serial port, as "/dev/ttyUSB0".
        timeout: time-out of the first byte, and of the remaining bytes, of a response [s].
        retries: number of retries of an exchange.

    Raises:
        InputError: a time-out or a number of retries is out of range.
        LineError: the port cannot be opened.
    """

    def __init__(self, port: str, *, timeout: float, retries: int) -> None:
        if not 0.0 < timeout <= 10.0 or not 0 <= retries <= 100:
            raise InputError(f"are {timeout}, {retries}.", field="timeout, retries", hint="give seconds, and a number")
        self._port, self._timeout, self._retries = port, timeout, retries
        self._unsafe = "it is not activated"
        self._client: Client | None = self._opened()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    @property
    def unsafe(self) -> str:
        """Reason why moves are refused; empty if they are accepted."""
        return self._unsafe

    @property
    def repeated(self) -> int:
        """Number of repeated exchanges since the port was opened."""
        return self._client.repeated if self._client is not None else 0

    def moving(self) -> bool:
        """Return whether the fingers move."""
        with self._secured():
            return self._moves()

    def wait(self, seconds: float = 5.0) -> None:
        """Wait until the fingers stop.

        Raises:
            GripperError: they still move after ``seconds`` [s]; a stop command is then sent.
        """
        with self._secured():
            self._until(lambda: not self._moves(), seconds, "still moves")

    def close(self) -> None:
        """Close the port; a grasped object stays grasped."""
        if self._client is not None:
            self._client.close()
        self._client, self._unsafe = None, "its port is closed"

    @abstractmethod
    def _opened(self) -> Client:
        """Open the port."""

    @abstractmethod
    def _moves(self) -> bool:
        """Read whether the fingers move."""

    @abstractmethod
    def _halt(self, client: Client) -> None:
        """Send a stop command without retries."""

    @property
    def _open_client(self) -> Client:
        if self._client is None:
            raise LineError(f"is not open: {self._unsafe}.", file=self._port, hint="activate the gripper")
        return self._client

    def _reopen(self) -> None:
        """Open a lost port again; moves are refused until the activation ends."""
        if self._client is None:
            self._client = self._opened()
        self._unsafe = "it is not activated"

    def _check_safe(self) -> None:
        if self._unsafe:
            raise GripperError(f"takes no move: {self._unsafe}.", field=self._port, hint="activate it")

    def _until(self, condition: Callable[[], bool], seconds: float, failure: str) -> None:
        until = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > until:
                hint = "check its power; activate it"
                raise GripperError(f"{failure} after {seconds:g} s.", field=self._port, hint=hint)
            time.sleep(_POLL)

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
                self._halt(self._client)
            except LineError:
                lost = True
            except GripperError as error:
                _log.warning("it may still move: %s", error)
        if lost:
            self._client.close()
            self._client = None


def _ports() -> str:
    from serial.tools.list_ports import comports

    names = ", ".join(port.device for port in comports())
    return f"ports here: {names}" if names else "there is no serial port here; plug the adapter in"
