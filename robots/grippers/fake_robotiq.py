"""Emulator of a Robotiq 2F gripper on a pseudo-terminal, byte for byte, with the faults of serial lines."""

from __future__ import annotations

import time

import numpy as np

from splatbot.errors import InputError
from splatbot.robots.grippers.fake_line import FakeLine, LineFaults
from splatbot.robots.grippers.line import FramingError
from splatbot.robots.grippers.modbus import EXCEPTION, READ, READ_INPUT, WRITE, framed, unframed
from splatbot.robots.grippers.registers import COMMAND, REGISTERS, STATUS, Activation, Command, Fingers, Status
from splatbot.robots.grippers.robotiq import MODELS

_TOO_EARLY, _NOT_ACTIVATED, _RELEASED = 0x05, 0x07, 0x0F  # gFLT
_HOLDING_CURRENT = 100  # [mA]


class FakeRobotiq(FakeLine):
    """Gripper whose fingers move at their speed, stop at an object, and respond on the serial port ``port``.

    Args:
        model: "2f-85" or "2f-140".
        width: width of the object between the fingers [m], 0 for no object. May be changed at any time.
        faults: faults of the line.
        hurry: speed relative to a real gripper; may be changed at any time.
        device: Modbus address.
        seed: seed of the faults.

    Raises:
        InputError: the model is unknown.
    """

    def __init__(
        self,
        model: str = "2f-85",
        *,
        width: float = 0.0,
        faults: LineFaults | None = None,
        hurry: float = 1.0,
        device: int = 9,
        seed: int = 0,
    ) -> None:
        if model not in MODELS:
            raise InputError(f"is {model!r}.", field="model", hint=f"models: {', '.join(MODELS)}")
        self.model, self.hurry, self._device = MODELS[model], hurry, device
        self.width = width
        self.fault = 0  # gFLT that it reports until it is reset
        self._command = Command(activate=False, go=False)
        self._position = float(self.model.open_at)
        self._ready_at: float | None = None  # None without activation
        self._stopped = Fingers.THERE
        self._last = time.monotonic()
        super().__init__(faults, seed=seed)

    @property
    def commanded(self) -> Command:
        """Last command."""
        return self._command

    def _length(self, data: bytes) -> int:
        if len(data) < 7:
            return 8
        return 9 + data[6] if data[1] == WRITE else 8

    def _respond(self, request: bytes) -> bytes | None:
        try:
            body = unframed(request)
        except FramingError:
            return None
        if body[0] != self._device:
            return None
        self.requests.append(body)
        return framed(self._answer(body))

    def _answer(self, body: bytes) -> bytes:
        function, address = body[1], int.from_bytes(body[2:4], "big")
        self._advance()
        if function in (READ, READ_INPUT):
            count = int.from_bytes(body[4:6], "big")
            if address >= STATUS and address + count <= STATUS + REGISTERS:
                start = 2 * (address - STATUS)
                return body[:2] + bytes([2 * count]) + self._status().to_bytes()[start : start + 2 * count]
        elif function == WRITE and address == COMMAND and len(body) == 7 + 2 * REGISTERS:
            self._obey(Command.from_bytes(body[7:]))
            return body[:6]
        else:
            return bytes([body[0], function | EXCEPTION, 1])
        return bytes([body[0], function | EXCEPTION, 2])

    def _obey(self, command: Command) -> None:
        m = self.model
        if not command.activate:
            self._ready_at, self.fault = None, _NOT_ACTIVATED if command.go else 0
        elif command.release:
            self._position = float(m.open_at if command.release_opens else m.closed_at)
            self.fault = _RELEASED
        elif self._ready_at is None:
            # The fingers close and open once, at half of their speed.
            self._ready_at = time.monotonic() + 4 * m.stroke / m.speed[1] / self.hurry
        elif command.go and not self._ready:
            self.fault = _TOO_EARLY
        self._command = command

    @property
    def _ready(self) -> bool:
        return self._ready_at is not None and time.monotonic() >= self._ready_at

    def _advance(self) -> None:
        """Advance the fingers to the present time."""
        now = time.monotonic()
        passed, self._last = now - self._last, now
        if not (self._command.go and self._ready) or self.fault:
            return
        m = self.model
        counts = (m.closed_at - m.open_at) / m.stroke
        speed = m.speed[0] + self._command.speed / 255 * (m.speed[1] - m.speed[0])
        step = speed * self.hurry * counts * passed
        target = float(np.clip(self._command.position, m.open_at, m.closed_at))
        moved = self._position + float(np.clip(target - self._position, -step, step))
        contact = m.closed_at - self.width * counts if self.width > 0 else np.inf
        stopped = moved >= contact and target > contact
        self._position = min(moved, contact) if stopped else moved
        there = Fingers.THERE if self._position == target else Fingers.MOVING
        self._stopped = Fingers.STOPPED_CLOSING if stopped else there

    def _status(self) -> Status:
        activation = Activation.RESET if self._ready_at is None else Activation.RUNNING
        activation = Activation.DONE if self._ready else activation
        return Status(
            activated=self._command.activate,
            going=self._command.go,
            activation=activation,
            fingers=self._stopped if self._command.go and self._ready else Fingers.MOVING,
            fault=self.fault,
            requested=self._command.position,
            position=round(self._position),
            current=_HOLDING_CURRENT if self._stopped is Fingers.STOPPED_CLOSING else 0,
        )
