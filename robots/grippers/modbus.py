"""Modbus RTU over a serial line: frames, checksums, and exchanges."""

from __future__ import annotations

import struct
from collections.abc import Callable

from splatbot.robots.grippers.errors import RefusedError
from splatbot.robots.grippers.line import FramingError, LineClient

READ, READ_INPUT, WRITE = 0x03, 0x04, 0x10  # functions: holding registers, input registers, several registers
EXCEPTION = 0x80  # added to the function of an answer that refuses
BAUD = 115200
_REFUSALS = {1: "no such function", 2: "no such register", 3: "no such value", 4: "it failed", 6: "it is busy"}


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


class ModbusClient(LineClient):
    """Client of one Modbus device on a line."""

    def read(self, address: int, count: int) -> bytes:
        """Read ``count`` registers of two bytes from an address on.

        Raises:
            NoAnswerError, LineError, RefusedError: the exchange fails.
        """
        body = struct.pack(">BBHH", self._device, READ, address, count)
        answer = self._request(body, 3 + 2 * count, lambda a: a[2] == 2 * count)
        return answer[3:]

    def write(self, address: int, data: bytes, *, retries: int | None = None) -> None:
        """Write registers from an address on; a write without a response is repeated and must be idempotent.

        Raises:
            NoAnswerError, LineError, RefusedError: the exchange fails.
        """
        head = struct.pack(">BBHH", self._device, WRITE, address, len(data) // 2)
        self._request(head + bytes([len(data)]) + data, 6, lambda a: a == head, retries)

    def _request(self, body: bytes, length: int, fits: Callable[[bytes], bool], retries: int | None = None) -> bytes:
        def receive() -> bytes:
            start = self._read(2)
            refused = bool(start[1] & EXCEPTION)
            answer = unframed(start + self._read((5 if refused else length + 2) - 2))
            if refused and answer[:2] == bytes([self._device, body[1] | EXCEPTION]):
                text = _REFUSALS.get(answer[2], f"exception {answer[2]}")
                raise RefusedError(f"refuses: {text}.", field=self._name, hint="check that it is this model")
            if answer[:2] != body[:2] or not fits(answer):
                raise FramingError(f"an answer to something else, {answer.hex(' ')}")
            return answer

        return self._exchange(framed(body), receive, retries)
