"""Recorded and generated RGB-D streams."""

from __future__ import annotations

from pathlib import Path

from splatbot.errors import LogError
from splatbot.logs.base import Log
from splatbot.logs.calibration import Calibration
from splatbot.logs.tum import Missing, TumLog

__all__ = ["Calibration", "Log", "open_log"]


def open_log(uri: str | Path, *, camera: str | Path | Calibration | None = None, missing: Missing = "auto") -> Log:
    """Open the log that ``uri`` names; frames are decoded only when read.

    Args:
        uri: a folder in TUM layout.
        camera: a preset (tum_fr1, tum_fr2, tum_fr3), an `intrinsics.json` or a calibration, instead of the log's own.
        missing: what a colour image without depth means, see :class:`splatbot.logs.tum.TumLog`.

    Raises:
        LogError: nothing there, of unknown layout, or damaged.
        CameraError: there are no usable intrinsics.
    """
    folder = Path(uri)
    if not folder.is_dir():
        what = "is a file, logs are folders" if folder.exists() else "does not exist"
        raise LogError(f"{what}.", file=folder, field="log", hint="give the folder that holds the recording")
    if any((folder / name).exists() for name in ("rgb.txt", "depth.txt")):
        return TumLog(folder, camera=camera, missing=missing)
    raise LogError(
        "holds no log of a known layout.",
        file=folder,
        field="log",
        hint="looked for rgb.txt with depth.txt (TUM)",
    )
