"""Cameras as the input of commands, recorded while their frames are used."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from splatbot.errors import InputError
from splatbot.layouts import REPLAY

if TYPE_CHECKING:
    from splatbot.logs.live import RecordedCamera


def refuse_with_camera(given: Mapping[str, object]) -> None:
    """Refuse flags, by their values, that do not go with a camera.

    Raises:
        InputError: a value is not None.
    """
    for flag, value in given.items():
        if value is not None:
            hint = "leave it out, or record the camera first: splatbot record CAMERA --out FILE"
            if flag == "--robot":
                hint = (
                    "the service masks the arm of a live camera: splatbot serve --robot (docs/guide/robot-in-view.md)"
                )
            raise InputError("is for recordings.", field=flag, hint=hint)


def open_recorded(
    uri: str, path: Path, *, max_frames: int | None, seconds: float | None, overwrite: bool = False
) -> RecordedCamera:
    """Open a camera that is recorded into a file from now on; see :class:`splatbot.logs.live.RecordedCamera`.

    Raises:
        DeviceError: there is no such camera.
        InputError: an option of the address is wrong.
        LogError: the file exists or cannot be written.
    """
    from splatbot.logs.live import RecordedCamera
    from splatbot.robots.cameras import open_camera

    if seconds is not None and not 0 < seconds < 1e6:
        raise InputError(f"is {seconds}.", field="--seconds", hint="give seconds, above 0")
    if uri.startswith(REPLAY) and Path(uri.removeprefix(REPLAY).partition("?")[0]).resolve() == path.resolve():
        raise InputError("is the recording that is replayed.", file=path, field="--out", hint="name another place")
    return RecordedCamera(open_camera(uri), path, max_frames=max_frames, seconds=seconds, overwrite=overwrite)
