"""Feetech's serial protocol (SCS, version 0) and the memory of its STS servos.

A packet is FF FF, id, length, instruction or error, parameters, checksum. The length counts the bytes after it. The
checksum is the complement of the sum of all bytes between header and checksum. Words of STS servos are little-endian;
signed values are a magnitude with a sign bit. Addresses and bits are those of Feetech's memory table of the STS series.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from splatbot.robots.grippers.line import FramingError, LineClient

READ, WRITE = 0x02, 0x03  # instructions
BAUD = 1_000_000
HEADER = b"\xff\xff"

MODEL, MODE = 3, 33  # addresses
COMMAND, FEEDBACK, MEMORY = 40, 56, 67  # first bytes of commands and feedback, end of the feedback
MODELS = {777: "STS3215", 2825: "STS3250"}
COUNTS = 4096  # of one turn

OVERLOAD = 0x20
FAULTS = {
    0x01: "its voltage is out of range",
    0x02: "its encoder fails",
    0x04: "it is too hot",
    0x08: "its current was too high",
    OVERLOAD: "it was overloaded",
}
_POSITION_SIGN, _LOAD_SIGN = 15, 10  # bits


def packet(device: int, code: int, parameters: bytes = b"") -> bytes:
    """Build a packet; the code is the instruction of a request, or the error of a response."""
    body = bytes([device, len(parameters) + 2, code]) + parameters
    return HEADER + body + bytes([~sum(body) & 0xFF])


def unpacked(data: bytes) -> tuple[int, int, bytes]:
    """Return device, code and parameters of a packet.

    Raises:
        FramingError: header, length or checksum are wrong.
    """
    if len(data) < 6 or data[3] != len(data) - 4 or packet(data[2], data[4], data[5:-1]) != data:
        raise FramingError(f"a wrong header, length or checksum in {data.hex(' ')}")
    return data[2], data[4], data[5:-1]


class ServoClient(LineClient):
    """Client of one servo on a line."""

    def read(self, address: int, count: int, *, retries: int | None = None) -> bytes:
        """Read ``count`` bytes from an address on; the bits of faults in the response are not checked.

        Raises:
            NoAnswerError, LineError: the exchange fails.
        """
        return self._request(READ, bytes([address, count]), count, retries)

    def write(self, address: int, data: bytes, *, retries: int | None = None) -> None:
        """Write bytes from an address on; a write without a response is repeated and must be idempotent.

        Raises:
            NoAnswerError, LineError: the exchange fails.
        """
        self._request(WRITE, bytes([address]) + data, 0, retries)

    def _request(self, instruction: int, parameters: bytes, count: int, retries: int | None) -> bytes:
        request = packet(self._device, instruction, parameters)
        expected = HEADER + bytes([self._device, count + 2])

        def receive() -> bytes:
            answer = self._read(4)
            if answer != expected:
                raise FramingError(f"an answer to something else, or an echo, {answer.hex(' ')}")
            answer += self._read(count + 2)
            if answer == request:
                raise FramingError("an echo of the request; the adapter must suppress it")
            return unpacked(answer)[2]

        return self._exchange(request, receive, retries)


@dataclass(frozen=True)
class ServoCommand:
    """Bytes 40 to 49 of the memory.

    Args:
        goal: position [counts].
        speed: largest speed [counts/s].
        torque: largest torque, 0..1000 per mille of the stall torque.
        acceleration: in units of 100 counts/s²; 0 for the largest.
        enabled: whether the motor is on.
    """

    goal: int = 0
    speed: int = 0
    torque: int = 0
    acceleration: int = 0
    enabled: bool = True

    def to_bytes(self) -> bytes:
        """Encode ten bytes for the memory from ``COMMAND`` on; the goal time is 0."""
        goal = _signed(self.goal, _POSITION_SIGN)
        return struct.pack("<BBHHHH", self.enabled, self.acceleration, goal, 0, self.speed, self.torque)

    @classmethod
    def from_bytes(cls, data: bytes) -> ServoCommand:
        """Decode ten bytes."""
        enabled, acceleration, goal, _, speed, torque = struct.unpack("<BBHHHH", data)
        return cls(_value(goal, _POSITION_SIGN), speed, torque, acceleration, enabled == 1)


@dataclass(frozen=True)
class ServoStatus:
    """Bytes 40 to 66 of the memory.

    Args:
        command: the command that the servo executes.
        position: present position [counts].
        speed: present speed [counts/s].
        load: present duty of the motor in per mille, with the sign of the direction.
        voltage: supply [V].
        temperature: of the servo [°C].
        error: bits of ``FAULTS``.
        moving: whether the speed is above the servo's threshold.
    """

    command: ServoCommand
    position: int
    speed: int
    load: int
    voltage: float
    temperature: int
    error: int
    moving: bool

    def to_bytes(self) -> bytes:
        """Encode the bytes of the memory from ``COMMAND`` to ``MEMORY``; bytes 50 to 55 and 64 are 0."""
        words = (_signed(self.position, _POSITION_SIGN), _signed(self.speed, _POSITION_SIGN))
        feedback = (*words, _signed(self.load, _LOAD_SIGN), round(10 * self.voltage), self.temperature)
        return self.command.to_bytes() + bytes(6) + struct.pack("<HHHBBBBB", *feedback, 0, self.error, self.moving)

    @classmethod
    def from_bytes(cls, data: bytes) -> ServoStatus:
        """Decode the bytes of the memory from ``COMMAND`` to ``MEMORY``."""
        fields = struct.unpack("<HHHBBBBB", data[FEEDBACK - COMMAND :])
        position, speed, load, voltage, temperature, _, error, moving = fields
        return cls(
            ServoCommand.from_bytes(data[:10]),
            _value(position, _POSITION_SIGN),
            _value(speed, _POSITION_SIGN),
            _value(load, _LOAD_SIGN),
            voltage / 10,
            temperature,
            error,
            moving != 0,
        )

    @property
    def fault_text(self) -> str:
        """Description of the faults; empty without a fault."""
        known = [text for bit, text in FAULTS.items() if self.error & bit]
        return ", ".join(known) or ("an unknown fault" if self.error else "")


def _signed(value: int, sign: int) -> int:
    """Encode an integer as a magnitude with a sign bit."""
    return abs(value) | (value < 0) << sign


def _value(word: int, sign: int) -> int:
    """Decode a magnitude with a sign bit."""
    magnitude = word & (1 << sign) - 1
    return -magnitude if word >> sign & 1 else magnitude
