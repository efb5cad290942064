"""The modules of ur_rtde with an arm behind them that smooths its set points, on a clock of its own.

The classes have the names and signatures of ur_rtde 1.6; nothing of them comes from a real controller.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatbot.protocols import Array


@dataclass
class FakeUr:
    """An arm of Universal Robots.

    Args:
        position: (6,) where it stands [rad].
        smoothing: time constant with which it follows set points [s].

    Attributes:
        commands: set points of servoJ, each (6,).
        calls: names of the stops that were commanded, with their deceleration.
        safety, connected, running, silent, slips, refuses, deaf: states and faults.
    """

    position: Array
    smoothing: float = 0.0
    velocity: Array = field(default_factory=lambda: np.zeros(6))
    commands: list[Array] = field(default_factory=list)
    servo_options: set[tuple[float, ...]] = field(default_factory=set)
    calls: list[tuple[str, float]] = field(default_factory=list)
    clock: float = 10.0
    safety: int = 1  # bits; bit 0 is the normal mode
    connected: bool = True
    running: bool = True
    silent: bool = False
    slips: float = 0.0
    refuses: bool = False
    deaf: bool = False
    disconnected: int = 0

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Put the modules where an import finds them."""
        control, receive = ModuleType("rtde_control"), ModuleType("rtde_receive")
        control.RTDEControlInterface = lambda host, frequency: _Control(self, host)  # type: ignore[attr-defined]
        receive.RTDEReceiveInterface = lambda host, frequency: _Receive(self, host)  # type: ignore[attr-defined]
        monkeypatch.setitem(__import__("sys").modules, "rtde_control", control)
        monkeypatch.setitem(__import__("sys").modules, "rtde_receive", receive)

    def servo(self, q: Array, period: float) -> None:
        """Follow a set point for one period."""
        before = self.position
        share = 1.0 - np.exp(-period / self.smoothing) if self.smoothing else 1.0
        self.position = before + share * (q - before) + self.slips
        self.velocity = (self.position - before) / period

    def halt(self) -> None:
        if not self.deaf:
            self.velocity = np.zeros(6)


class _Interface:
    def __init__(self, arm: FakeUr, host: str) -> None:
        if host != "ur":
            raise RuntimeError(f"Error: Could not connect to: {host} at 30004, verify the IP")
        self.arm = arm

    def isConnected(self) -> bool:
        return self.arm.connected

    def disconnect(self) -> None:
        self.arm.disconnected += 1


class _Control(_Interface):
    def initPeriod(self) -> float:
        return self.arm.clock

    def waitPeriod(self, begun: float) -> None:
        pass

    def isProgramRunning(self) -> bool:
        return self.arm.running

    def servoJ(self, q: ArrayLike, speed: float, acceleration: float, time: float, ahead: float, gain: float) -> bool:
        if not self.arm.connected:
            raise RuntimeError("lost")
        target = np.asarray(q, np.float64)
        assert target.shape == (6,)
        self.arm.commands.append(target)
        self.arm.servo_options.add((time, ahead, gain))
        self.arm.servo(target, time)
        return not self.arm.refuses

    def stopScript(self) -> None:
        self.arm.running = False

    def servoStop(self, a: float = 10.0) -> bool:
        self.arm.calls.append(("servoStop", a))
        self.arm.halt()
        return True

    def stopJ(self, a: float = 2.0, asynchronous: bool = False) -> None:
        self.arm.calls.append(("stopJ", a))
        self.arm.halt()


class _Receive(_Interface):
    def getActualQ(self) -> list[float]:
        return [float(q) for q in self.arm.position]

    def getActualQd(self) -> list[float]:
        return [float(v) for v in self.arm.velocity]

    def getTimestamp(self) -> float:
        self.arm.clock += 0.0 if self.arm.silent else 0.002
        return self.arm.clock

    def getSafetyStatusBits(self) -> int:
        return self.arm.safety
