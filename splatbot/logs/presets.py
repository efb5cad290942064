"""Published calibrations of well-known sensors, by the name that `--camera` takes.

TUM RGB-D (Sturm et al. 2012): https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from pathlib import Path

from splatbot.camera import Camera
from splatbot.errors import CameraError
from splatbot.logs.calibration import Calibration, read_calibration

_TUM_UNITS = 5000.0

PRESETS = {
    "tum_fr1": Calibration(
        Camera(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)), _TUM_UNITS, "tum_fr1"
    ),
    "tum_fr2": Calibration(
        Camera(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)), _TUM_UNITS, "tum_fr2"
    ),
    "tum_fr3": Calibration(Camera(535.4, 539.2, 320.1, 247.6, 640, 480), _TUM_UNITS, "tum_fr3"),
}


def find_calibration(camera: str | Path | Calibration) -> Calibration:
    """Return a calibration from a calibration, the name of a preset, or an `intrinsics.json` file.

    Raises:
        CameraError: ``camera`` is neither a preset nor a file, or the file is invalid.
    """
    if isinstance(camera, Calibration):
        return camera
    if str(camera) in PRESETS:
        return PRESETS[str(camera)]
    if Path(camera).is_file():
        return read_calibration(camera)
    raise CameraError(
        f"{str(camera)!r} is neither a preset nor a file.",
        field="camera",
        hint=f"use {', '.join(PRESETS)} or the path of an intrinsics.json",
    )
