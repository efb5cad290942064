"""Emulator of a gripper with one Feetech STS servo on a pseudo-terminal, byte for byte, with the faults of lines."""

from __future__ import annotations

import time

import numpy as np

from splatbot.robots.grippers.fake_line import FakeLine, LineFaults
from splatbot.robots.grippers.feetech import JawCalibration
from splatbot.robots.grippers.line import FramingError
from splatbot.robots.grippers.scs import (
    COMMAND,
    FEEDBACK,
    MEMORY,
    MODEL,
    OVERLOAD,
    READ,
    WRITE,
    ServoCommand,
    ServoStatus,
    packet,
    unpacked,
)

_STS3215 = 777
_VOLTAGE, _TEMPERATURE = 7.4, 30
_FREE_LOAD = 20  # per mille, of a jaw that moves without contact


class FakeFeetech(FakeLine):
    """Servo that turns at its speed, stops at an object under load, and responds on the serial port ``port``.

    The torque limit is the load at an object; acceleration, heat and the protection against overload are not emulated.

    Args:
        jaw: calibration of the jaw on the servo.
        width: width of the object between the fingers [m], 0 for no object. May be changed at any time.
        faults: faults of the line.
        hurry: speed relative to a real servo; may be changed at any time.
        device: number of the servo.
        seed: seed of the faults.

    Attributes:
        error: bits of the faults that it reports; an overload ends when the torque is switched off.
        memory: (256,) bytes; those of the feedback are computed for each response.
    """

    def __init__(
        self,
        jaw: JawCalibration,
        *,
        width: float = 0.0,
        faults: LineFaults | None = None,
        hurry: float = 1.0,
        device: int = 6,
        seed: int = 0,
    ) -> None:
        self.jaw, self.width, self.hurry, self._device = jaw, width, hurry, device
        self.error = 0
        self.memory = bytearray(256)
        self.memory[MODEL : MODEL + 2] = _STS3215.to_bytes(2, "little")
        self._position = float(jaw.opened)
        self._speed, self._load = 0, 0
        self._last = time.monotonic()
        super().__init__(faults, seed=seed)

    @property
    def commanded(self) -> ServoCommand:
        """Command in the memory."""
        return ServoCommand.from_bytes(bytes(self.memory[COMMAND : COMMAND + 10]))

    def restart(self) -> None:
        """Forget the command, as after a dip of the supply."""
        self.memory[COMMAND:FEEDBACK] = bytes(FEEDBACK - COMMAND)

    def _length(self, data: bytes) -> int:
        return 6 if len(data) < 4 else max(6, data[3] + 4)

    def _respond(self, request: bytes) -> bytes | None:
        try:
            device, instruction, parameters = unpacked(request)
        except FramingError:
            return None
        if device != self._device or not parameters:
            return None
        self.requests.append(request)
        self._advance()
        address, data = parameters[0], parameters[1:]
        if instruction == READ and len(data) == 1:
            return packet(device, self.error, bytes(self.memory[address : address + data[0]]))
        if instruction == WRITE and address >= 5 and address + len(data) <= FEEDBACK:
            self.memory[address : address + len(data)] = data
            if not self.memory[COMMAND]:
                self.error &= ~OVERLOAD
            return packet(device, self.error)
        return None

    def _advance(self) -> None:
        """Turn the servo to the present time, and compute the feedback."""
        now = time.monotonic()
        passed, self._last = now - self._last, now
        command = self.commanded
        self._speed = self._load = 0
        if command.enabled:
            self._turn(command, command.speed * self.hurry * passed)
        status = ServoStatus(
            command,
            round(self._position),
            self._speed,
            self._load,
            _VOLTAGE,
            _TEMPERATURE,
            self.error,
            self._speed != 0,
        )
        self.memory[FEEDBACK:MEMORY] = status.to_bytes()[FEEDBACK - COMMAND :]

    def _turn(self, command: ServoCommand, step: float) -> None:
        moved = self._position + float(np.clip(command.goal - self._position, -step, step))
        closing = 1 if self.jaw.closed > self.jaw.opened else -1
        contact = self.jaw.count(self.width) if self.width > 0 else closing * np.inf
        if closing * (command.goal - contact) > 0 and closing * (moved - contact) >= 0:
            self._position, self._load = float(contact), closing * command.torque
            return
        self._position = moved
        if moved != command.goal:
            direction = 1 if command.goal > moved else -1
            self._speed, self._load = direction * command.speed, direction * min(_FREE_LOAD, command.torque)
