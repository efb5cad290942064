"""Cameras of LeRobot datasets, which have no place for intrinsics: files that the user adds to their folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbot.errors import CameraError
from splatbot.logs.calibration import Calibration, read_calibration, read_object
from splatbot.logs.poses import rigid_pose
from splatbot.logs.presets import find_calibration
from splatbot.logs.registration import ColorRegistration

INTRINSICS, DEPTH_INTRINSICS = "intrinsics.json", "depth_intrinsics.json"
_TRANSFORM = "T_color_depth"


def find_cameras(folder: Path, camera: str | Path | Calibration | None) -> tuple[Calibration, ColorRegistration | None]:
    """Return the calibration of the frames, and the registration of colour if depth has a camera of its own.

    `intrinsics.json` is the camera of colour, and of depth that is registered to it. `depth_intrinsics.json` is the
    camera of other depth, with `T_color_depth`: 4 rows of 4 numbers [m], points of depth to those of colour.

    Args:
        folder: of the dataset.
        camera: camera of both images, which replaces the files.

    Raises:
        CameraError: there are no usable intrinsics.
    """
    if camera is not None:
        return find_calibration(camera), None
    path, depth_path = folder / INTRINSICS, folder / DEPTH_INTRINSICS
    if not path.exists():
        hint = "write it with fx, fy, cx, cy, width, height [px] and depth_scale, or give --camera FILE"
        raise CameraError("the dataset has no intrinsics.", file=path, field="camera", hint=hint)
    color = read_calibration(path)
    if not depth_path.exists():
        return color, None
    depth = read_calibration(depth_path)
    for file, calibration in ((path, color), (depth_path, depth)):
        if calibration.camera.distortion:
            hint = "undistort the images, or register depth to colour when it is recorded"
            raise CameraError("cannot be registered.", file=file, field="distortion", hint=hint)
    try:
        T_color_depth = rigid_pose(np.asarray(read_object(depth_path).get(_TRANSFORM), np.float64).reshape(4, 4))
    except (TypeError, ValueError, OverflowError):
        T_color_depth = None
    if T_color_depth is None:
        hint = "write 4 rows of 4 numbers: a rotation and a translation [m]"
        raise CameraError("is no rigid transform.", file=depth_path, field=_TRANSFORM, hint=hint)
    return depth, ColorRegistration(color.camera, depth.camera, T_color_depth)
