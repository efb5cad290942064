"""Scenes of Nerfstudio whose frames have depth images: `transforms.json` with `depth_file_path` (Nerfstudio, data).

Camera axes are those of OpenGL: x right, y up, z backwards. Principal points count pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, LogError
from splatbot.logs.base import MILLIMETRES
from splatbot.logs.calibration import Calibration, number, read_object
from splatbot.logs.pairs import PairLog, name_order, pair_files, stamps_of_names
from splatbot.logs.poses import rigid_pose
from splatbot.logs.presets import find_calibration

NAME = "transforms.json"

_FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_MODEL = ("camera_model", "is_fisheye", "k4")
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")


class TransformsLog(PairLog):
    """A Nerfstudio scene with depth; frames are ordered by the numbers in their names.

    Names that are seconds, as 1305031102.175304.png, are stamps; other names give the n-th frame the stamp n / 30 s.

    All frames have the camera of the file: a log has one camera. Depth is in millimetres unless
    `depth_unit_scale_factor` holds another unit [m]. Frames without depth are counted in ``unpaired``.

    Args:
        folder: of the scene.
        camera: intrinsics that replace those of the file.

    Raises:
        LogError: a frame is damaged, a path leaves the folder, or no frame has depth.
        CameraError: the file is no JSON object, or its intrinsics are not usable or differ between frames.
    """

    def __init__(self, folder: str | Path, *, camera: str | Path | Calibration | None = None) -> None:
        place = Path(folder)
        self._file = place / NAME
        values = read_object(self._file)
        listed = values.get("frames")
        if not isinstance(listed, list) or not all(isinstance(frame, dict) for frame in listed):
            raise self._bad("frames", "is no list of objects", "write the file again")
        frames = sorted(enumerate(listed), key=lambda entry: name_order(str(entry[1].get("file_path"))))
        colors = {n: self._path(place, f"frames[{i}].file_path", f.get("file_path")) for n, (i, f) in enumerate(frames)}
        depths = {
            n: self._path(place, f"frames[{i}].depth_file_path", f["depth_file_path"])
            for n, (i, f) in enumerate(frames)
            if f.get("depth_file_path") is not None
        }
        if len(set(colors.values())) < len(colors):
            raise self._bad("frames", "list one image twice", "remove one of both frames")
        pairs, self.unpaired = pair_files(place, colors, depths)
        stamps = stamps_of_names(place, [path.name for path in colors.values()])
        self._matrices = [self._matrix(*frames[pair.number]) for pair in pairs]
        calibration = self._calibration(values, listed) if camera is None else find_calibration(camera)
        super().__init__(folder, pairs, [stamps[pair.number] for pair in pairs], calibration)

    def _poses(self) -> Iterable[NDArray[np.float64] | None]:
        return (rigid_pose(matrix @ _FLIP_YZ) for matrix in self._matrices)

    def _path(self, folder: Path, field: str, name: Any) -> Path:
        """Return the path of an image, which must lie in the folder."""
        parts = PurePosixPath(name) if isinstance(name, str) and "\0" not in name else None
        if parts is None or parts.is_absolute() or ".." in parts.parts:
            raise self._bad(field, f"is {name!r:.80}", "name an image in the folder of the scene")
        return folder / parts

    def _matrix(self, index: int, frame: dict[str, Any]) -> NDArray[np.float64]:
        try:
            T = np.array(frame.get("transform_matrix"), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            T = np.zeros(0)
        if T.shape == (3, 4):
            T = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
        if T.shape != (4, 4):
            hint = "write 4 rows of 4 numbers, or remove the frame"
            raise self._bad(f"frames[{index}].transform_matrix", "is no matrix (4, 4)", hint)
        return T

    def _calibration(self, values: dict[str, Any], frames: list[dict[str, Any]]) -> Calibration:
        keys = (*_KEYS, *_COEFFICIENTS, *_MODEL)
        cameras = [{key: {**values, **frame}.get(key) for key in keys} for frame in frames]
        if any(camera != cameras[0] for camera in cameras):
            hint = "a log has one camera: undistort the images to one, or name it by --camera FILE"
            raise CameraError("differ between frames.", file=self._file, field="intrinsics", hint=hint)
        model, fisheye, k4 = (cameras[0][key] for key in _MODEL)
        if model not in (None, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE") or fisheye or k4:
            hint = "undistort the images, or name their camera by --camera FILE"
            lens = f"is {model!r:.80}, is_fisheye {fisheye!r:.20}, k4 {k4!r:.20}"
            raise CameraError(f"{lens}.", file=self._file, field="camera_model", hint=hint)
        fx, fy, cx, cy, width, height = (number(self._file, cameras[0], key) for key in _KEYS)
        distortion = tuple(number(self._file, {"k": cameras[0][key] or 0}, "k") for key in _COEFFICIENTS)
        unit = number(self._file, {"depth_unit_scale_factor": 1 / MILLIMETRES, **values}, "depth_unit_scale_factor")
        if not 1e-9 < unit < 1e9:
            hint = "give metres per unit: 0.001 for millimetres"
            raise CameraError(f"is {unit:g}.", file=self._file, field="depth_unit_scale_factor", hint=hint)
        try:
            camera = Camera(
                fx, fy, cx - 0.5, cy - 0.5, round(width), round(height), distortion if any(distortion) else ()
            )
        except CameraError as error:
            raise CameraError(error.message, file=self._file, field=error.field, hint=error.hint) from error
        except (ValueError, OverflowError) as error:
            raise CameraError(f"are no sizes ({error}).", file=self._file, field="w, h", hint="give pixels") from error
        return Calibration(camera, 1 / unit, str(self._file))

    def _bad(self, field: str, problem: str, hint: str) -> LogError:
        return LogError(f"{problem}.", file=self._file, field=field, hint=hint)
