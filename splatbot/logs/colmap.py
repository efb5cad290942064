"""Scenes of COLMAP with a folder of depth images, as logs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, LogError
from splatbot.formats.colmap import CameraRow, ImageRow, read_cameras, read_images
from splatbot.geometry import inverse, pose_from_quat
from splatbot.layouts import COLMAP_DEPTH, colmap_model
from splatbot.logs.base import MILLIMETRES
from splatbot.logs.calibration import Calibration
from splatbot.logs.pairs import PairLog, name_order, pair_files, stamps_of_names
from splatbot.logs.poses import rigid_pose
from splatbot.logs.presets import find_calibration

DEPTH_SCALE = "depth_scale"
OPTIONS = (DEPTH_SCALE,)
"""Options of the address of a scene."""

_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order


class ColmapLog(PairLog):
    """A COLMAP scene whose images have depth images of the same names in `depth/` or `depths/`, as PNG or TIFF.

    Frames are ordered by the numbers in their names. Names that are seconds, as 1305031102.175304.png, are stamps;
    other names give the n-th image the stamp n / 30 s. All images have one camera.

    Args:
        folder: of the scene, with `images/` and a model in `sparse/0`, `sparse` or the folder itself.
        camera: intrinsics and unit of depth that replace those of the model.
        options: `depth_scale`, units of depth per metre; millimetres without it.

    Raises:
        LogError: no image has depth, a name leaves the folder or is there twice, or the unit is no positive number.
        FormatError: a file of the model is damaged.
        CameraError: the images have several cameras, or a lens that is not OpenCV's.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        camera: str | Path | Calibration | None = None,
        options: dict[str, str] | None = None,
    ) -> None:
        place = Path(folder)
        model = colmap_model(place) or place
        suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
        file = model / f"images{suffix}"
        rows = sorted(read_images(file), key=lambda row: name_order(row.name))
        names = [_relative(file, row.name) for row in rows]
        if len(set(names)) < len(names):
            raise LogError("lists one image twice.", file=file, field="NAME", hint="remove one of both images")
        depths = next((place / name for name in COLMAP_DEPTH if (place / name).is_dir()), place / COLMAP_DEPTH[0])
        colors = {n: place / "images" / name for n, name in enumerate(names)}
        found = {n: depth for n, name in enumerate(names) if (depth := _depth_file(depths / name)) is not None}
        pairs, self.unpaired = pair_files(place, colors, found)
        self._rows = [rows[pair.number] for pair in pairs]
        calibration = (
            _calibration(model / f"cameras{suffix}", self._rows) if camera is None else find_calibration(camera)
        )
        scale = _depth_scale(place, options or {}, calibration.depth_scale)
        every = stamps_of_names(place, [name.name for name in names])
        stamps = [every[pair.number] for pair in pairs]
        super().__init__(
            folder, pairs, stamps, Calibration(calibration.camera, scale, calibration.file, calibration.sensor)
        )

    def _poses(self) -> Iterable[NDArray[np.float64] | None]:
        return (_pose(row) for row in self._rows)


def _pose(row: ImageRow) -> NDArray[np.float64] | None:
    """Return T_world_camera (4, 4) of an image in the unit of the model, or None if it is damaged."""
    try:
        return rigid_pose(inverse(pose_from_quat(row.translation, row.quat)))
    except ValueError:
        return None


def _relative(file: Path, name: str) -> PurePosixPath:
    path = PurePosixPath(name)
    if "\0" in name or path.is_absolute() or ".." in path.parts:
        hint = "name an image below the folder images"
        raise LogError(f"is {name!r:.80}.", file=file, field="NAME", hint=hint)
    return path


def _depth_file(path: Path) -> Path | None:
    """Return the depth image of a name, with any suffix of a depth image."""
    places = (path.with_suffix(suffix) for suffix in (".png", ".tiff", ".tif"))
    return next((place for place in places if place.is_file()), None)


def _calibration(file: Path, rows: list[ImageRow]) -> Calibration:
    """Return the one camera of the images, with depth in millimetres."""
    cameras = {camera.camera_id: camera for camera in read_cameras(file)}
    used = [cameras.get(row.camera_id) for row in rows]
    first = used[0]
    if first is None or any(camera is None or camera[1:] != first[1:] for camera in used):
        hint = "a log has one camera: run COLMAP with --ImageReader.single_camera 1, or name it by --camera FILE"
        raise CameraError("are missing or differ between images.", file=file, field="cameras", hint=hint)
    return Calibration(_camera(file, first), MILLIMETRES, str(file))


def _camera(file: Path, row: CameraRow) -> Camera:
    if "FISHEYE" in row.model:
        hint = "undistort the images (`colmap image_undistorter`), or name their camera by --camera FILE"
        raise CameraError(f"is {row.model}.", file=file, field="MODEL", hint=hint)
    values = row.params
    fx, lens = values.get("fx", values.get("f", math.nan)), tuple(values.get(name, 0.0) for name in _COEFFICIENTS)
    kept = lens if any(lens[5:]) else lens[:5]
    try:
        # Principal points of COLMAP count pixel centres at +0.5.
        centre = values["cx"] - 0.5, values["cy"] - 0.5
        return Camera(fx, values.get("fy", fx), *centre, *row.size, kept if any(kept) else ())
    except CameraError as error:
        raise CameraError(error.message, file=file, field=error.field, hint=error.hint) from error


def _depth_scale(folder: Path, options: dict[str, str], default: float) -> float:
    text = options.get(DEPTH_SCALE)
    if text is None:
        return default
    try:
        scale = float(text)
    except ValueError:
        scale = math.nan
    if not 0.0 < scale < 1e9:
        hint = f"give units of depth per metre: ?{DEPTH_SCALE}=5000"
        raise LogError(f"is {text!r:.40}.", file=folder, field=DEPTH_SCALE, hint=hint)
    return scale
