"""Cameras as the input of commands, recorded while their frames are used."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from splatbot.errors import InputError
from splatbot.layouts import REPLAY, is_camera, log_kind

if TYPE_CHECKING:
    from splatbot.logs.live import RecordedCamera


def is_live(uri: str) -> bool:
    """Return whether an address is a camera, or a file that lists cameras.

    Raises:
        LogError: the file is damaged.
    """
    if is_camera(uri) or not uri.endswith((".yaml", ".yml")) or log_kind(uri) != "rig":
        return is_camera(uri)
    from splatbot.logs.rig import lists_cameras

    return lists_cameras(uri)


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
    """Open a camera, or a file that lists cameras, that is recorded from now on.

    See :class:`splatbot.logs.live.RecordedCamera` for the files.

    Raises:
        DeviceError: there is no such camera.
        InputError: an option of the address is wrong.
        LogError: the file exists or cannot be written.
    """
    from splatbot.logs.live import RecordedCamera
    from splatbot.robots.cameras import CameraRig, open_camera

    if seconds is not None and not 0 < seconds < 1e6:
        raise InputError(f"is {seconds}.", field="--seconds", hint="give seconds, above 0")
    if uri.startswith(REPLAY) and Path(uri.removeprefix(REPLAY).partition("?")[0]).resolve() == path.resolve():
        raise InputError("is the recording that is replayed.", file=path, field="--out", hint="name another place")
    if is_camera(uri):
        return RecordedCamera(open_camera(uri), path, max_frames=max_frames, seconds=seconds, overwrite=overwrite)
    rig = CameraRig(uri, open_camera)
    if max_frames is not None and max_frames <= len(rig.cameras):
        count = len(rig.cameras) + 1
        raise InputError(f"is {max_frames} for {count} cameras.", field="--max-frames", hint=f"give {count} or more")
    return RecordedCamera(
        rig,
        path,
        cameras=rig.cameras,
        first_name=rig.first_name,
        max_frames=max_frames,
        seconds=seconds,
        overwrite=overwrite,
    )
