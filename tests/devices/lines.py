"""Serial lines whose time-outs end by the emulated device: a busy machine, which answers late, loses no answer."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import pytest
import serial

from splatbot.robots.grippers.fake_line import FakeLine
from tests.waiting import until


class EmulatedSerial(serial.Serial):
    """Serial port whose time-out ends when the device is silent, or if its answers are delayed beyond the time-out.

    Args:
        device: at the other end.
    """

    def __init__(self, device: FakeLine, *words: Any, **options: Any) -> None:
        self._device = device
        super().__init__(*words, **options)

    def read(self, size: int = 1, /) -> bytes:
        """Return ``size`` bytes, or those that have arrived when the time-out ends."""
        if self._device.faults.delay > float(self.timeout):
            time.sleep(float(self.timeout))
            return b""
        begun = self._device.silences
        while self.in_waiting < size and self._device.silences < begun + 2:
            time.sleep(1e-4)
        return bytes(super().read(min(size, self.in_waiting)))


def emulate_timeouts(monkeypatch: pytest.MonkeyPatch, device: FakeLine) -> None:
    """Make drivers open their ports as :class:`EmulatedSerial`."""
    monkeypatch.setattr("splatbot.robots.grippers.line.serial.Serial", partial(EmulatedSerial, device))


def wait_for_rest(device: FakeLine) -> None:
    """Wait until a device has answered or discarded all requests."""
    begun = device.silences
    until(lambda: device.silences >= begun + 2)
