"""Folders `color/` and `depth/` of numbered images, as the recorders of Open3D and RealSense and ScanNet write them.

Sources: Open3D, PinholeCameraIntrinsic and RGBDVideoMetadata; ScanNet, SensReader.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, LogError
from splatbot.geometry import inverse
from splatbot.logs.base import MILLIMETRES
from splatbot.logs.calibration import Calibration, make_calibration, read_calibration, read_object
from splatbot.logs.image_size import image_size
from splatbot.logs.pairs import RATE, ImagePair, PairLog, numbered_files, pair_files
from splatbot.logs.poses import read_matrix, rigid_pose
from splatbot.logs.presets import find_calibration
from splatbot.logs.registration import ColorRegistration

_OPEN3D_NAMES = ("intrinsic.json", "camera_intrinsic.json")
_COLOR, _DEPTH, _POSE = (
    rf"(?:.*\D)?(?<!\d\.)(?P<n>\d+)\.(?:{suffixes})" for suffixes in ("jpe?g|png", "png|tiff?", "txt")
)

_CENTRE = 0.25, 0.75  # [1] of the image sides between which the principal point of a real camera lies

_log = logging.getLogger(__name__)


class ImageFolderLog(PairLog):
    """A folder of `color/N.jpg` (or png) and `depth/N.png`, in millimetres unless the intrinsics hold another scale.

    Frame number n has the stamp n / 30 s. `timestamps.txt` replaces these by one stamp [s] a line, one for each colour
    image. `pose/N.txt` are reference poses T_world_camera. Images without a partner are counted in ``unpaired``.

    Intrinsics are those of `intrinsics.json`, Open3D's `intrinsic.json` or `camera_intrinsic.json`, or ScanNet's
    `intrinsic/`. The last has two cameras: colour is then resampled at the depth pixels.

    Args:
        folder: of the log.
        camera: intrinsics of both images that replace the log's own.

    Raises:
        LogError: no colour image has a depth image, two files have one number, or `timestamps.txt` is damaged.
        CameraError: there are no usable intrinsics.
    """

    def __init__(self, folder: str | Path, *, camera: str | Path | Calibration | None = None) -> None:
        place = Path(folder)
        colors = numbered_files(place / "color", _COLOR)
        pairs, self.unpaired = pair_files(place, colors, numbered_files(place / "depth", _DEPTH))
        stamps = _stamps(place / "timestamps.txt", sorted(colors))
        calibration, registration = _calibrate(place, pairs, camera)
        super().__init__(folder, pairs, [stamps[pair.number] for pair in pairs], calibration, registration)

    def _poses(self) -> Iterable[NDArray[np.float64] | None]:
        poses = numbered_files(self.folder / "pose", _POSE) if (self.folder / "pose").is_dir() else {}
        for pair in self._pairs:
            path = poses.get(pair.number)
            yield None if path is None else rigid_pose(read_matrix(path))


def _stamps(path: Path, numbers: Sequence[int]) -> dict[int, float]:
    """Return the stamp [s] of each frame number, from a file if it exists."""
    if not path.exists():
        return {number: number / RATE for number in numbers}
    hint = "write one stamp [s] a line, increasing, for each colour image; or remove the file"
    try:
        values = [float(line) for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise LogError(f"is damaged ({error}).", file=path, field="stamps", hint=hint) from error
    if len(values) != len(numbers):
        problem = f"has {len(values)} stamps, there are {len(numbers)} colour images."
        raise LogError(problem, file=path, field="stamps", hint=hint)
    if not np.isfinite(values).all() or (np.diff(values) <= 0).any():
        raise LogError("does not increase.", file=path, field="stamps", hint=hint)
    return dict(zip(numbers, values, strict=True))


def _calibrate(
    folder: Path, pairs: Sequence[ImagePair], camera: str | Path | Calibration | None
) -> tuple[Calibration, ColorRegistration | None]:
    """Return the calibration of the frames, and the registration of colour if it has a camera of its own."""
    if camera is not None:
        return find_calibration(camera), None
    if (folder / "intrinsics.json").exists():
        return read_calibration(folder / "intrinsics.json"), None
    for name in _OPEN3D_NAMES:
        if (folder / name).exists():
            return _open3d_calibration(folder / name), None
    if (folder / "intrinsic").is_dir():
        return _scannet_calibration(folder / "intrinsic", pairs)
    raise CameraError(
        "the log has no intrinsics.",
        file=folder / _OPEN3D_NAMES[0],
        field="camera",
        hint="write Open3D's PinholeCameraIntrinsic there, or name an intrinsics.json: --camera FILE",
    )


def _open3d_calibration(path: Path) -> Calibration:
    values = read_object(path)
    matrix = values.get("intrinsic_matrix")
    if not isinstance(matrix, list) or len(matrix) != 9:
        hint = "write [fx, 0, 0, 0, fy, 0, cx, cy, 1], column by column"
        raise CameraError("is no list of 9 numbers.", file=path, field="intrinsic_matrix", hint=hint)
    named = {"depth_scale": MILLIMETRES, **values, "fx": matrix[0], "fy": matrix[4], "cx": matrix[6], "cy": matrix[7]}
    return make_calibration(path, named, scale_key="depth_scale")


def _scannet_calibration(folder: Path, pairs: Sequence[ImagePair]) -> tuple[Calibration, ColorRegistration]:
    color, depth = (
        scannet_camera(folder / f"intrinsic_{part}.txt", read_matrix(folder / f"intrinsic_{part}.txt"), size)
        for part, size in (("color", _size([p.color for p in pairs])), ("depth", _size([p.depth for p in pairs])))
    )
    for part, camera in (("color", color), ("depth", depth)):
        _check_centre(folder / f"intrinsic_{part}.txt", camera)
    places = [folder / f"extrinsic_{part}.txt" for part in ("color", "depth")]
    extrinsics = [read_matrix(path) if path.exists() else np.eye(4) for path in places]
    registration = ColorRegistration(color, depth, scannet_transform(folder, *extrinsics))
    return Calibration(depth, MILLIMETRES, str(folder / "intrinsic_depth.txt")), registration


def _check_centre(source: Path, camera: Camera) -> None:
    """Refuse intrinsics of another image size, as of images that were resized after ScanNet's export."""
    low, high = _CENTRE
    shares = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
    if not all(low <= share <= high for share in shares):
        problem = f"has its centre at {camera.cx:.0f}, {camera.cy:.0f} of images of {camera.width}x{camera.height} px"
        hint = "give the intrinsics of this image size; ScanNet's are those of the images as recorded"
        raise CameraError(f"{problem}.", file=source, field="intrinsics", hint=hint)


def _size(paths: Sequence[Path]) -> tuple[int, int]:
    """Return the size of the first image that has a header."""
    for path in paths:
        try:
            with path.open("rb") as file:
                size = image_size(file)
        except OSError:
            continue  # an error of its frame
        if size is not None:
            return size
    raise LogError("is no PNG or JPEG.", file=paths[0], field="image size", hint="copy the images again")


def scannet_camera(source: Path, matrix: NDArray[np.floating], size: tuple[int, int]) -> Camera:
    """Return the camera of ScanNet's intrinsic matrix (4, 4) and an image size [px].

    Raises:
        CameraError: the values are not those of a camera.
    """
    fx, fy, cx, cy = (float(matrix[row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    try:
        return Camera(fx, fy, cx, cy, *size)
    except CameraError as error:
        raise CameraError(error.message, file=source, field=error.field, hint=error.hint) from error


def scannet_transform(source: Path, color: NDArray[np.floating], depth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return T_color_depth (4, 4) of ScanNet's extrinsics, which map points of the sensor to each camera.

    Raises:
        CameraError: an extrinsic matrix is not rigid.
    """
    T_color_sensor, T_depth_sensor = rigid_pose(color), rigid_pose(depth)
    if T_color_sensor is None or T_depth_sensor is None:
        hint = "write a rotation and a translation [m]"
        raise CameraError("is not rigid.", file=source, field="extrinsic", hint=hint)
    T_color_depth = T_color_sensor @ inverse(T_depth_sensor)
    if not np.allclose(T_color_depth, np.eye(4), atol=1e-6):
        distance = 1e3 * float(np.linalg.norm(T_color_depth[:3, 3]))
        _log.warning("%s: colour and depth are %.0f mm apart; see Registration in docs/guide/logs.md", source, distance)
    return T_color_depth
