"""Emulator of a Robotiq 2F gripper on a pseudo-terminal, byte for byte, with the faults of serial lines."""

from __future__ import annotations

import os
import pty
import select
import threading
import time
import tty
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType

import numpy as np

from splatbot.errors import InputError
from splatbot.robots.grippers.modbus import EXCEPTION, READ, READ_INPUT, WRITE, FramingError, framed, unframed
from splatbot.robots.grippers.registers import COMMAND, REGISTERS, STATUS, Activation, Command, Fingers, Status
from splatbot.robots.grippers.robotiq import MODELS

_SILENCE = 0.004  # [s] that ends a frame
_TOO_EARLY, _NOT_ACTIVATED, _RELEASED = 0x05, 0x07, 0x0F  # gFLT
_HOLDING_CURRENT = 100  # [mA]


@dataclass
class LineFaults:
    """Faults of the serial line; they may be changed at any time.

    Args:
        drop: fraction of lost bytes in both directions.
        flip: fraction of bytes with one wrong bit.
        half: fraction of responses that end in the middle.
        delay: delay before each response [s].
        silent: True suppresses all responses.
    """

    drop: float = 0.0
    flip: float = 0.0
    half: float = 0.0
    delay: float = 0.0
    silent: bool = False


class FakeRobotiq(AbstractContextManager["FakeRobotiq"]):
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
        self.width, self.faults = width, faults if faults is not None else LineFaults()
        self.fault = 0  # gFLT that it reports until it is reset
        self.requests: list[bytes] = []  # complete requests
        self._rng = np.random.default_rng(seed)
        self._command = Command(activate=False, go=False)
        self._position = float(self.model.open_at)
        self._ready_at: float | None = None  # None without activation
        self._stopped = Fingers.THERE
        self._last = time.monotonic()
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._plugged = True
        self._thread = threading.Thread(target=self._serve, name="fake-robotiq", daemon=True)
        self._thread.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.unplug()

    @property
    def commanded(self) -> Command:
        """Last command."""
        return self._command

    def unplug(self) -> None:
        """Close the port permanently."""
        if self._plugged:
            self._plugged = False
            self._thread.join()
            os.close(self._master)
            os.close(self._slave)

    def _serve(self) -> None:
        data = b""
        while self._plugged:
            ready, _, _ = select.select([self._master], [], [], _SILENCE)
            if not ready:
                data = b""  # silence ends a frame, whole or not
                continue
            data += self._through(os.read(self._master, 256))
            if len(data) >= _request_length(data):
                self._take(data)
                data = b""

    def _take(self, data: bytes) -> None:
        try:
            body = unframed(data)
        except FramingError:
            return
        if body[0] != self._device:
            return
        self.requests.append(body)
        answer = framed(self._answer(body))
        time.sleep(self.faults.delay)
        if self.faults.silent:
            return
        if self._rng.random() < self.faults.half:
            answer = answer[: len(answer) // 2]
        os.write(self._master, self._through(answer))

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

    def _through(self, data: bytes) -> bytes:
        """Apply the faults of the line to bytes."""
        if not (self.faults.drop or self.faults.flip):
            return data
        kept = [byte for byte in data if self._rng.random() >= self.faults.drop]
        return bytes(b ^ 1 << int(self._rng.integers(8)) if self._rng.random() < self.faults.flip else b for b in kept)


def _request_length(data: bytes) -> int:
    """Return the length of a request from its first bytes."""
    if len(data) < 7:
        return 8
    return 9 + data[6] if data[1] == WRITE else 8
