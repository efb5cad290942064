"""Errors of grippers."""

from __future__ import annotations

from splatbot.errors import GripperError


class NoAnswerError(GripperError):
    """The device sends no valid response within all retries, or a command does not end in time (TIMED_OUT)."""

    code = -6


class LineError(GripperError):
    """The connection to the gripper cannot be opened, or is gone."""


class RefusedError(GripperError):
    """The device refuses a request."""


class FaultError(GripperError):
    """The gripper reports a fault.

    Args:
        fault: its number; the bits of several faults for a servo.
        text: its description.
        field: the gripper.
        hint: a fix.
    """

    def __init__(self, fault: int, text: str, *, field: str, hint: str = "activate it") -> None:
        self.fault = fault
        super().__init__(f"reports fault {fault:#04x}: {text}.", field=field, hint=hint)
