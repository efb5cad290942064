"""Hierarchy of errors. Each error states the problem, its place (file, field) and a fix."""

from __future__ import annotations

from pathlib import Path


class SplatbotError(Exception):
    """Base of every error that splatbot raises on purpose.

    Args:
        message: the problem, in one sentence.
        file: the file at fault, if there is one.
        field: the field, property, column or argument at fault.
        hint: a fix that the user can apply.

    ``http_status`` is the status code of the service, ``exit_code`` the exit code of the command line. ``code`` is the
    nearest value of ``moveit_msgs/MoveItErrorCodes``; 99999 is FAILURE.
    """

    http_status = 500
    exit_code = 1
    code = 99999

    def __init__(
        self, message: str, *, file: str | Path | None = None, field: str | None = None, hint: str | None = None
    ) -> None:
        self.message = message
        self.file = str(file) if file is not None else None
        self.field = field
        self.hint = hint
        super().__init__(str(self))

    def __str__(self) -> str:
        where = ": ".join(part for part in (self.file, self.field) if part)
        text = f"{where}: {self.message}" if where else self.message
        return f"{text} Fix: {self.hint}" if self.hint else text


class InputError(SplatbotError):
    """An input of the user (an argument, a file, a request) cannot be used."""

    http_status = 422
    exit_code = 2


class LogError(InputError):
    """A recorded log, or one of its frames, cannot be read."""


class CameraError(InputError):
    """Camera intrinsics are missing or invalid."""


class FormatError(InputError):
    """A map or trajectory file is damaged or of an unknown format."""


class ConfigError(InputError):
    """A configuration file, environment variable or flag is wrong."""


class ControllerError(SplatbotError):
    """A controller cannot execute a command (CONTROL_FAILED)."""

    http_status = 409
    code = -4


class GripperError(ControllerError):
    """A gripper does not execute a command; a stop command was sent to it if it still received commands."""


class DeviceError(SplatbotError):
    """A device is gone or does not answer."""

    http_status = 503


class MapNotFoundError(SplatbotError):
    """No map of that name."""

    http_status = 404
    exit_code = 2


class NativeError(SplatbotError):
    """The native module is missing or cannot run on this machine."""

    http_status = 503


class DeprecatedNameWarning(FutureWarning):
    """A deprecated name is in use; it still works, and the message contains the current name."""
