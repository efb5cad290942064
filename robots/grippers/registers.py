"""Registers of Robotiq's 2F grippers (2F-85 & 2F-140 instruction manual, chapter 4)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from splatbot.errors import GripperError

COMMAND, STATUS = 0x03E8, 0x07D0  # first of three registers each
REGISTERS = 3
_ACT, _GTO, _ATR, _ARD = 0x01, 0x08, 0x10, 0x20


class Activation(IntEnum):
    """State of the activation, gSTA."""

    RESET = 0
    RUNNING = 1
    DONE = 3


class Fingers(IntEnum):
    """Motion and contact of the fingers, gOBJ."""

    MOVING = 0
    STOPPED_OPENING = 1
    STOPPED_CLOSING = 2
    THERE = 3


NO_COMMUNICATION = 0x09
FAULTS = {
    0x05: "the action waits for the activation to end",
    0x07: "it is not activated",
    0x08: "it is too hot",
    NO_COMMUNICATION: "it received no message for a second",
    0x0A: "its voltage is too low",
    0x0B: "the automatic release is under way",
    0x0C: "an internal fault",
    0x0D: "the activation failed",
    0x0E: "its current was too high",
    0x0F: "the automatic release is done",
}


@dataclass(frozen=True)
class Command:
    """Command registers.

    Args:
        activate: rACT; False resets the gripper and clears faults.
        go: rGTO; False stops the fingers.
        position: rPR, 0 open .. 255 closed.
        speed, force: rSP and rFR, 0 smallest .. 255 largest.
        release: rATR, automatic release, after which the gripper must be activated again.
        release_opens: rARD, direction of the automatic release.
    """

    activate: bool = True
    go: bool = True
    position: int = 0
    speed: int = 255
    force: int = 255
    release: bool = False
    release_opens: bool = False

    def to_bytes(self) -> bytes:
        """Encode six bytes for the registers from ``COMMAND`` on."""
        action = _ACT * self.activate | _GTO * self.go | _ATR * self.release | _ARD * self.release_opens
        return bytes([action, 0, 0, self.position, self.speed, self.force])

    @classmethod
    def from_bytes(cls, data: bytes) -> Command:
        """Decode six bytes."""
        a, (position, speed, force) = data[0], data[3:6]
        return cls(bool(a & _ACT), bool(a & _GTO), position, speed, force, bool(a & _ATR), bool(a & _ARD))


@dataclass(frozen=True)
class Status:
    """Status registers.

    Args:
        activated: gACT.
        going: gGTO.
        activation: gSTA.
        fingers: gOBJ.
        fault: gFLT, 0 without a fault.
        requested: gPR, echo of the last commanded position.
        position: gPO, 0 open .. 255 closed.
        current: gCU [mA].
    """

    activated: bool
    going: bool
    activation: Activation
    fingers: Fingers
    fault: int
    requested: int
    position: int
    current: int

    def to_bytes(self) -> bytes:
        """Encode six bytes of the registers from ``STATUS`` on."""
        first = _ACT * self.activated | _GTO * self.going | self.activation << 4 | self.fingers << 6
        return bytes([first, 0, self.fault, self.requested, self.position, self.current // 10])

    @classmethod
    def from_bytes(cls, data: bytes) -> Status:
        """Decode six bytes.

        Raises:
            GripperError: gSTA has an undefined value.
        """
        first, fault = data[0], data[2] & 0x0F
        try:
            activation = Activation(first >> 4 & 3)
        except ValueError as error:
            hint = "check that the device is a Robotiq 2F"
            raise GripperError(f"is {first:#04x}, an undefined value.", field="status", hint=hint) from error
        fingers = Fingers(first >> 6)
        return cls(bool(first & _ACT), bool(first & _GTO), activation, fingers, fault, data[3], data[4], 10 * data[5])

    @property
    def fault_text(self) -> str:
        """Description of the fault; empty without a fault."""
        return FAULTS.get(self.fault, f"fault {self.fault:#04x}") if self.fault else ""
