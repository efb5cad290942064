"""Modbus RTU over a serial line: frames, checksums, and exchanges with time-outs and retries."""

from __future__ import annotations

import logging
import struct
import termios
import threading
import time
from collections.abc import Callable
from typing import Any

import serial

from splatbot.errors import GripperError

READ, READ_INPUT, WRITE = 0x03, 0x04, 0x10  # functions: holding registers, input registers, several registers
EXCEPTION = 0x80  # added to the function of an answer that refuses
_QUIET = 0.004  # [s] of silence between frames; 3.5 characters take 0.3 ms at 115200 baud, USB adapters hold back more
_REFUSALS = {1: "no such function", 2: "no such register", 3: "no such value", 4: "it failed", 6: "it is busy"}
_GONE = (serial.SerialException, OSError, termios.error)

_log = logging.getLogger(__name__)


class NoAnswerError(GripperError):
    """The device sends no valid response within all retries (TIMED_OUT)."""

    code = -6


class LineError(GripperError):
    """The serial port cannot be opened, or is gone."""


class RefusedError(GripperError):
    """The device refuses a request with a Modbus exception."""


class FramingError(Exception):
    """Bytes that are no frame; the exchange is worth another try."""


def crc16(data: bytes) -> int:
    """Compute the Modbus checksum: polynomial 0xA001 reflected, from 0xFFFF (Modbus over Serial Line V1.02, 6.2.2)."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def framed(body: bytes) -> bytes:
    """Append the checksum, low byte first, to device, function and data."""
    return body + struct.pack("<H", crc16(body))


def unframed(frame: bytes) -> bytes:
    """Remove the checksum that :func:`framed` appends.

    Raises:
        FramingError: the checksum is wrong or missing.
    """
    if len(frame) < 4 or framed(frame[:-2]) != frame:
        raise FramingError(f"a wrong checksum in {frame.hex(' ')}")
    return frame[:-2]


def open_line(port: str, *, timeout: float) -> Any:
    """Open a serial port at 115200 8N1 exclusively.

    Raises:
        LineError: it cannot be opened.
    """
    try:
        return serial.Serial(port, 115200, timeout=timeout, write_timeout=timeout, exclusive=True)
    except (*_GONE, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise LineError(f"cannot be opened ({reason}).", file=port, hint=_ports()) from error


class ModbusClient:
    """Client of one device on a line. Every exchange ends within (retries + 1) · 4 time-outs.

    Args:
        line: an open ``serial.Serial`` with a time-out [s].
        device: Modbus address.
        retries: number of tries after the first.
    """

    def __init__(self, line: Any, device: int, *, retries: int = 4) -> None:
        self._line, self._device, self._retries = line, device, retries
        self._lock = threading.Lock()  # one exchange at a time: a stop may come from another thread
        self.repeated = 0  # exchanges that were tried again

    def read(self, address: int, count: int) -> bytes:
        """Read ``count`` registers of two bytes from an address on.

        Raises:
            NoAnswerError, LineError, RefusedError: the exchange fails.
        """
        body = struct.pack(">BBHH", self._device, READ, address, count)
        answer = self._exchange(body, 3 + 2 * count, lambda a: a[2] == 2 * count)
        return answer[3:]

    def write(self, address: int, data: bytes, *, retries: int | None = None) -> None:
        """Write registers from an address on; a write without a response is repeated and must be idempotent.

        Raises:
            NoAnswerError, LineError, RefusedError: the exchange fails.
        """
        head = struct.pack(">BBHH", self._device, WRITE, address, len(data) // 2)
        self._exchange(head + bytes([len(data)]) + data, 6, lambda a: a == head, retries)

    def close(self) -> None:
        """Close the port, without an error if it is gone."""
        with self._lock:
            try:
                self._line.close()
            except _GONE as error:
                _log.debug("closing: %s", error)

    def _exchange(self, body: bytes, length: int, fits: Callable[[bytes], bool], retries: int | None = None) -> bytes:
        tries = 1 + (self._retries if retries is None else retries)
        reason = ""
        for k in range(tries):
            try:
                with self._lock:
                    answer = self._once(framed(body), length + 2)
                if answer[:2] != body[:2] or not fits(answer):
                    raise FramingError(f"an answer to something else, {answer.hex(' ')}")
                return answer
            except FramingError as error:
                reason = str(error)
                self.repeated += k + 1 < tries
                _log.info("try %d of %d got %s", k + 1, tries, reason)
                self._drain()
        hint = "check cable, power and the device's number; try a longer timeout"
        raise NoAnswerError(
            f"gave no good answer to {tries} tries; the last was {reason}.", field=self._name, hint=hint
        )

    def _once(self, frame: bytes, length: int) -> bytes:
        try:
            self._line.reset_input_buffer()
            self._line.write(frame)
            answer = self._line.read(2)
            refused = len(answer) == 2 and answer[1] & EXCEPTION
            answer += self._line.read((5 if refused else length) - len(answer)) if len(answer) == 2 else b""
        except serial.SerialTimeoutException as error:
            raise FramingError("a line that takes no bytes") from error
        except _GONE as error:
            raise self._gone(error) from error
        if len(answer) < (5 if refused else length):
            raise FramingError(f"{len(answer)} of {length} bytes")
        good = unframed(answer)
        if refused and good[:2] == bytes([self._device, frame[1] | EXCEPTION]):
            text = _REFUSALS.get(good[2], f"exception {good[2]}")
            raise RefusedError(f"refuses: {text}.", field=self._name, hint="check that it is this model")
        return good

    def _drain(self) -> None:
        """Wait until the line is silent, at most one time-out, so that a late response is not read as the next one."""
        try:
            until = time.monotonic() + float(self._line.timeout)
            while time.monotonic() < until:
                time.sleep(_QUIET)
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


def _ports() -> str:
    from serial.tools.list_ports import comports

    names = ", ".join(port.device for port in comports())
    return f"ports here: {names}" if names else "there is no serial port here; plug the adapter in"
