"""Images of a calibration board with the arm's joints or poses: a folder of images, or a log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from splatbot.errors import CameraError, FormatError, InputError, LogError
from splatbot.logs import Log, open_log
from splatbot.logs.images import read_color

Array = NDArray[np.float64]

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_JOINTS = ("joint_values", "joints", "q")
_LAYOUT = "`joint_values: [q1, ...]` [rad], or `T_base_link` (4 rows of 4) [m], or `r_mtx` and `t_vec`"


@dataclass(frozen=True, eq=False)
class ArmView:
    """The arm at the time of an image.

    Args:
        name: name of the file or number of the frame.
        joints: (J,) [rad or m], if known.
        T_base_link: (4, 4) [m], if known.
    """

    name: str
    joints: Array | None = None
    T_base_link: Array | None = None


def read_views(source: str, *, max_views: int) -> Iterator[tuple[float, ArmView, NDArray[np.uint8]]]:
    """Read the images of a folder or a log one by one, at most ``max_views`` of them, evenly spread.

    Yields the share of the images that are read, the arm, and the image (H, W, 3).

    In a folder, a YAML or JSON file of the name of an image holds ``joint_values``, ``T_base_link``, or ``r_mtx`` and
    ``t_vec``. In a log, its frames have the joints of its ``joints.txt`` or of its topics.

    Raises:
        FormatError: a file next to an image is damaged.
        InputError: the folder has no images.
        LogError: the log or an image is damaged.
    """
    folder = Path(source)
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in _IMAGES) if folder.is_dir() else []
    if paths:
        for share, k in _spread(len(paths), max_views):
            yield share, ArmView(paths[k].name, *_beside(paths[k])), read_color(paths[k])
        return
    if folder.is_dir() and not any(folder.iterdir()):
        raise InputError("is empty.", file=source, hint="give a folder of images or a log")
    log = _open_raw(source)
    damaged: LogError | None = None
    whole = 0
    for share, k in _spread(len(log), max_views):
        try:
            frame = log[k]
        except LogError as error:  # one damaged frame of a log is no reason to stop
            damaged = error
            continue
        whole += 1
        yield share, ArmView(f"frame {k}", frame.joints), frame.rgb
    if damaged is not None and not whole:
        raise damaged


def _open_raw(source: str) -> Log:
    """Open a log whose images are not rectified, because their distortion is to be estimated."""
    try:
        log = open_log(source)
    except CameraError as error:
        hint = "give the folder of its colour images instead, such as LOG/rgb"
        raise InputError("has no intrinsics yet.", file=source, field="views", hint=hint) from error
    recorded = log.calibration
    if not recorded.camera.distortion:
        return log
    return open_log(source, camera=replace(recorded, camera=replace(recorded.camera, distortion=())))


def _spread(count: int, most: int) -> list[tuple[float, int]]:
    chosen = sorted(set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()))
    return [(number / len(chosen), k) for number, k in enumerate(chosen)]


def _beside(image: Path) -> tuple[Array | None, Array | None]:
    """Read joints and pose of the file next to an image; None without them."""
    for suffix in (".yaml", ".yml", ".json"):
        path = image.with_suffix(suffix)
        if not path.is_file():
            continue
        try:
            found = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise FormatError(f"cannot be read ({error}).", file=path, hint=f"write {_LAYOUT}") from error
        if not isinstance(found, dict):
            raise FormatError("is no mapping.", file=path, hint=f"write {_LAYOUT}")
        name = next((name for name in _JOINTS if name in found), None)
        joints = None if name is None else _numbers(path, name, found[name], (-1,))
        return joints, _pose(path, found)
    return None, None


def _pose(path: Path, found: dict[str, Any]) -> Array | None:
    if "T_base_link" in found:
        T = _numbers(path, "T_base_link", found["T_base_link"], (4, 4))
        if np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
            hint = "write rows, not columns: transpose the O_T_EE of a Franka robot"
            raise FormatError("has a last row other than 0 0 0 1.", file=path, field="T_base_link", hint=hint)
    elif "r_mtx" in found and "t_vec" in found:
        T = np.eye(4)
        R = _numbers(path, "r_mtx", found["r_mtx"], (-1,))
        if len(R) not in (9, 16):
            raise FormatError(f"has {len(R)} numbers.", file=path, field="r_mtx", hint="give 3 rows of 3 or 4 of 4")
        side = 3 if len(R) == 9 else 4
        T[:3, :3] = R.reshape(side, side)[:3, :3]
        T[:3, 3] = _numbers(path, "t_vec", found["t_vec"], (3,))
    else:
        return None
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3 or np.linalg.det(T[:3, :3]) < 0:
        raise FormatError("is no rotation.", file=path, field="pose", hint=f"write {_LAYOUT}")
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ Vt
    return T


def _numbers(path: Path, name: str, value: object, shape: tuple[int, ...]) -> Array:
    try:
        numbers = np.asarray(value, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all():
        raise FormatError("holds no finite numbers of that shape.", file=path, field=name, hint=f"write {_LAYOUT}")
    return numbers
