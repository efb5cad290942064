"""Scenes with poses in JSON: Blender (NeRF synthetic), Nerfstudio and instant-ngp.

Their cameras have OpenGL axes: x right, y up, z backward. Their principal points count pixel centres at +0.5.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import FormatError, LogError
from splatbot.formats.ply_file import read_ply
from splatbot.training.datasets.base import TrainingData, TrainingView, sorted_views
from splatbot.training.datasets.images import Lens, is_image, make_lens, open_photo, photo_size

_log = logging.getLogger(__name__)

_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = "OPENCV_FISHEYE"
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4")
_INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
_HELD_OUT_LISTS = ("val_filenames", "test_filenames")
_FLIP_YZ = np.array([1.0, -1.0, -1.0])
_MAX_SKEW = 1e-3  # largest deviation of a matrix from the nearest rotation
_MAX_VALUE = 1e9  # of an intrinsic [px] or a coordinate
_GREY = 128  # of points without colour


def blender_dataset(folder: Path, scale: int = 1) -> TrainingData:
    """Open a scene with `transforms_train.json`; the views of `transforms_test.json` and `_val.json` are held out.

    Args:
        folder: the scene.
        scale: factor by which width and height of the images are reduced.

    Raises:
        FormatError: a JSON file is damaged, or a value in it is not usable.
        LogError: no image of the training views exists, or the size of one is wrong.
    """
    train = TransformsFile(folder / "transforms_train.json")
    views, held_out = train.views(scale), list[TrainingView]()
    for name in ("transforms_test.json", "transforms_val.json"):
        if (folder / name).is_file():
            held_out += TransformsFile(folder / name).views(scale, required=False)
    no_points = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    names = tuple(view.name for view in held_out)
    return TrainingData("blender", folder, sorted_views(train.file, views + held_out), *no_points, names)


def nerfstudio_dataset(folder: Path, scale: int = 1) -> TrainingData:
    """Open a scene with `transforms.json`; the views of its `val_filenames` and `test_filenames` are held out.

    Args:
        folder: the scene.
        scale: factor by which width and height of the images are reduced.

    Raises:
        FormatError: the JSON file or the point cloud is damaged, or a value in it is not usable.
        LogError: no image exists, or the size of one is wrong.
    """
    transforms = TransformsFile(folder / "transforms.json")
    views = sorted_views(transforms.file, transforms.views(scale))
    marked = transforms.held_out_names()
    held_out = tuple(view.name for view in views if view.name in marked)
    return TrainingData("nerfstudio", folder, views, *transforms.points(), held_out)


class TransformsFile:
    """A JSON file of cameras and poses.

    Args:
        file: the file.

    Raises:
        FormatError: the file is not readable, or is no JSON object.
    """

    def __init__(self, file: Path) -> None:
        self.file, self._folder = file, file.parent
        try:
            values = json.loads(file.read_text(encoding="utf-8-sig"))
        except OSError as error:
            raise FormatError(f"cannot be read ({error.strerror}).", file=file, hint="check the path") from error
        except (ValueError, RecursionError) as error:
            raise FormatError(f"is not JSON ({error}).", file=file, hint="fix or copy the file again") from error
        if not isinstance(values, dict):
            raise FormatError("is no JSON object.", file=file, hint='write {"frames": [...], ...}')
        self._values: dict[str, Any] = values

    def views(self, scale: int, *, required: bool = True) -> list[TrainingView]:
        """Return the views whose images exist; one warning states the number of the others.

        Raises:
            FormatError: a frame is damaged.
            LogError: an image has a wrong size, or none exists although they are required.
        """
        frames = self._list("frames", dict)
        paths = [self._image_path(f"frames[{index}]", frame) for index, frame in enumerate(frames)]
        found = [index for index, path in enumerate(paths) if is_image(self._folder / path)]
        if required and not found:
            raise LogError(
                f"lists {len(frames)} images, of which none exists.",
                file=self.file,
                field="frames",
                hint=f"copy the images, such as {paths[0]}, to {self._folder}" if paths else "pose the images again",
            )
        if len(found) < len(frames):
            _log.warning("%s: %d of %d images are missing", self.file, len(frames) - len(found), len(frames))
        return [self._view(f"frames[{index}]", frames[index], paths[index], scale) for index in found]

    def held_out_names(self) -> set[str]:
        """Return the names of the images that the file lists for validation and tests."""
        return {_name(path) for key in _HELD_OUT_LISTS if key in self._values for path in self._list(key, str)}

    def points(self) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Read the points (M, 3) and colours (M, 3) of `ply_file_path`; M is 0 without this key.

        Raises:
            FormatError: the point cloud is missing or damaged.
        """
        path = self._values.get("ply_file_path")
        if path is None:
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        if not isinstance(path, str):
            raise self._bad("ply_file_path", f"is {path!r}", "name a PLY file")
        return read_point_cloud(self._folder / path)

    def _list(self, key: str, kind: type) -> list[Any]:
        """Return a list of the file whose entries are all of a type."""
        values = self._values.get(key)
        if not isinstance(values, list) or not all(isinstance(value, kind) for value in values):
            raise self._bad(key, f"is no list of {kind.__name__}", "write the file again, or correct the list")
        return values

    def _image_path(self, field: str, frame: Mapping[str, Any]) -> str:
        """Return the path of an image; Blender scenes leave out the suffix .png."""
        path = frame.get("file_path")
        if not isinstance(path, str):
            raise self._bad(f"{field}.file_path", f"is {path!r}", "name an image file")
        return next((p for p in (path, f"{path}.png") if is_image(self._folder / p)), path)

    def _view(self, field: str, frame: Mapping[str, Any], path: str, scale: int) -> TrainingView:
        photo = open_photo(self._folder / path, self._lens(field, frame, path), scale)
        return photo.view(_name(path), self._pose(f"{field}.transform_matrix", frame.get("transform_matrix")))

    def _lens(self, field: str, frame: Mapping[str, Any], path: str) -> Lens:
        """Return the lens of a frame; its own values precede those of the file."""
        values = self._numbers(field, {**self._values, **frame})
        size = photo_size(self._folder / path) if not {"w", "h"} <= values.keys() else (values["w"], values["h"])
        width, height = int(size[0]), int(size[1])
        if (width, height) != size:
            raise self._bad(f"{field} w, h", f"are {size[0]:g}, {size[1]:g}", "give whole pixels")
        fx = values.get("fl_x") or self._focal(field, values, "camera_angle_x", width)
        if fx is None:
            raise self._bad(f"{field} fl_x", "is missing", "give fl_x [px] or camera_angle_x [rad]")
        intrinsics = {
            "fx": fx,
            "fy": values.get("fl_y") or self._focal(field, values, "camera_angle_y", height) or fx,
            "cx": values.get("cx", 0.5 * width),
            "cy": values.get("cy", 0.5 * height),
            **{key: values[key] for key in _COEFFICIENTS if values.get(key)},
        }
        fisheye = self._fisheye(field, frame)
        if not fisheye and "k4" in intrinsics:
            hint = "undistort the images (ns-process-data, or `colmap image_undistorter`), or use OPENCV_FISHEYE"
            raise self._bad(f"{field} k4", f"is {values['k4']:g}; it exists only for OPENCV_FISHEYE", hint)
        return make_lens(self.file, field, (width, height), intrinsics, fisheye=fisheye)

    def _fisheye(self, field: str, frame: Mapping[str, Any]) -> bool:
        """Return whether the camera of a frame is a fisheye."""
        model = frame.get("camera_model", self._values.get("camera_model", "OPENCV"))
        if model not in (*_PERSPECTIVE, _FISHEYE):
            hint = "undistort the images (`colmap image_undistorter`)"
            supported = ", ".join((*_PERSPECTIVE, _FISHEYE))
            raise self._bad(f"{field} camera_model", f"is {model!r}; supported are {supported}", hint)
        return bool(model == _FISHEYE or frame.get("is_fisheye", self._values.get("is_fisheye", False)))

    def _focal(self, field: str, values: Mapping[str, float], key: str, length: int) -> float | None:
        """Return the focal length [px] of an angle of view, or None if the angle is not given."""
        angle = values.get(key)
        if angle is not None and not 0 < angle < math.pi:
            raise self._bad(f"{field} {key}", f"is {angle:g}", "give radians between 0 and π")
        return None if angle is None else 0.5 * length / math.tan(0.5 * angle)

    def _numbers(self, field: str, values: Mapping[str, Any]) -> dict[str, float]:
        """Return those values that intrinsics use."""
        found = {}
        for key in (*_INTRINSICS, *_COEFFICIENTS):
            value = values.get(key)
            if value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _MAX_VALUE:
                raise self._bad(f"{field} {key}", f"is {value!r:.40}", "give a finite number")
            found[key] = float(value)
        return found

    def _pose(self, field: str, matrix: Any) -> NDArray[np.float64]:
        """Return T_world_camera (4, 4), axes as OpenCV, of a matrix whose rotation may be rounded."""
        try:
            T = np.array(matrix, dtype=np.float64)
        except (ValueError, TypeError, OverflowError):
            T = np.zeros(0)
        if T.shape == (3, 4):
            T = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
        if T.shape != (4, 4) or not (np.abs(T) < _MAX_VALUE).all():  # False for NaN
            raise self._bad(field, "is no matrix (4, 4) of finite numbers", "pose the image again, or remove the frame")
        U, _, Vt = np.linalg.svd(T[:3, :3])
        R = U @ Vt
        error = float(max(np.abs(R - T[:3, :3]).max(), np.abs(T[3] - [0, 0, 0, 1]).max()))
        if error > _MAX_SKEW or np.linalg.det(R) < 0:
            hint = "write rotation and translation without scale"
            raise self._bad(field, f"is not rigid (deviates by {error:.3g}, determinant {np.linalg.det(R):.0f})", hint)
        T[:3, :3], T[3] = R * _FLIP_YZ, (0, 0, 0, 1)
        return T

    def _bad(self, field: str, problem: str, hint: str) -> FormatError:
        return FormatError(f"{problem}.", file=self.file, field=field, hint=hint)


def read_point_cloud(file: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read points (M, 3) and colours (M, 3) of a PLY file; points without 8-bit colours become grey.

    Raises:
        FormatError: the file is missing or damaged, or a coordinate is NaN or infinite.
    """
    if not is_image(file):
        hint = "copy the point cloud, or remove this key"
        raise FormatError("cannot be read: there is no such file.", file=file, field="ply_file_path", hint=hint)
    vertex = read_ply(file, ["vertex"]).get("vertex", np.zeros(0, [("none", "u1")]))
    names = vertex.dtype.names or ()
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        problem = f"is no point cloud: its vertices have no {', '.join(missing)}."
        raise FormatError(problem, file=file, field="vertex", hint="write a PLY with x, y, z")
    points = np.stack([vertex[axis].astype(np.float64) for axis in "xyz"], axis=1)
    if not np.isfinite(points).all():
        row = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise FormatError("holds NaN or infinity.", file=file, field=f"vertex {row}", hint="remove the point")
    if not all(name in names and vertex[name].dtype == np.uint8 for name in ("red", "green", "blue")):
        return points, np.full(points.shape, _GREY, np.uint8)
    return points, np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1)


def _name(path: str) -> str:
    """Return the name of a view: the path below the folder of the scene, also if the image is outside of it."""
    return "/".join(part for part in PurePosixPath(path).parts if part not in ("..", "/", "//"))
