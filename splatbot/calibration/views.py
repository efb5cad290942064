"""Images of a calibration board with the arm's joints or poses: a folder of images, or a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from splatbot.calibration.board import Board, BoardView
from splatbot.errors import CameraError, FormatError, InputError, LogError
from splatbot.geometry import nearest_rotation
from splatbot.logs import Log, open_log
from splatbot.logs.calibration import Calibration
from splatbot.logs.images import read_color

Array = NDArray[np.float64]

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_JOINTS = ("joint_values", "joints", "q")
_LAYOUT = "`joint_values: [q1, ...]` [rad], or `T_base_link` (4 rows of 4) [m], or `r_mtx` and `t_vec`"
_MOST_MISSES = 10  # images without the board before all others are given up: each is searched with all dictionaries


@dataclass(frozen=True, eq=False)
class ArmView:
    """The arm at the time of an image.

    Args:
        joints: (J,) [rad or m], if known.
        joint_names: their names; if empty, they are in the order of the robot.
        T_base_link: (4, 4) [m], if known.
    """

    joints: Array | None = None
    T_base_link: Array | None = None
    joint_names: tuple[str, ...] = ()


class ViewSource:
    """Images of one camera, with the arm at their times.

    In a folder, a YAML or JSON file of the name of an image holds ``joint_values``, ``T_base_link``, or ``r_mtx`` and
    ``t_vec``. In a log, the frames have the joints of its ``joints.txt`` or of its topics.

    Args:
        source: folder of images, or a log.

    Raises:
        InputError: the folder is empty, or the log has no intrinsics.
        LogError: the log does not exist or is damaged.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        folder = Path(source)
        self._images = sorted(p for p in folder.iterdir() if p.suffix.lower() in _IMAGES) if folder.is_dir() else []
        self._log = None if self._images else _open_raw(source)
        self.skipped = 0
        """Number of damaged frames of the log that were skipped."""

    @property
    def calibration(self) -> Calibration | None:
        """The log's calibration, without distortion; None for a folder of images."""
        return None if self._log is None else self._log.calibration

    def read(self, max_views: int) -> Iterator[tuple[float, ArmView, NDArray[np.uint8]]]:
        """Read images one by one, at most ``max_views`` of them, evenly spread; damaged frames of a log are skipped.

        Yields the share of the images that are read, the arm, and the image (H, W, 3).

        Raises:
            FormatError: a file next to an image is damaged.
            LogError: an image of a folder or all frames of a log are damaged.
        """
        count = len(self._images) if self._log is None else len(self._log)
        chosen = np.unique(np.linspace(0, count - 1, min(count, max_views)).round().astype(int)).tolist()
        damaged: LogError | None = None
        for number, k in enumerate(chosen):
            share = number / len(chosen)
            if self._log is None:
                yield share, _beside(self._images[k]), read_color(self._images[k])
                continue
            try:
                frame = self._log[k]
            except LogError as error:
                damaged, self.skipped = error, self.skipped + 1
                continue
            yield share, ArmView(frame.joints, joint_names=frame.joint_names), frame.rgb
        if damaged is not None and self.skipped == len(chosen):
            raise damaged


@dataclass(frozen=True, eq=False)
class BoardRecording:
    """Views of a board, with the arm at their times.

    Args:
        arms: arm at each view.
        views: corners of each view, possibly none.
        size: width and height of the images [px].
    """

    arms: list[ArmView]
    views: list[BoardView]
    size: tuple[int, int]


def find_board(
    source: ViewSource, board: Board, *, max_views: int, on_share: Callable[[float], None]
) -> BoardRecording:
    """Find a board in images. The first image that shows it completes an unknown dictionary or pattern.

    Args:
        source: images.
        board: the board.
        max_views: largest number of images, evenly spread.
        on_share: called with the share of the images that are read.

    Raises:
        InputError: the images differ in size, or none of the first ten shows the board.
    """
    arms, views, sizes = list[ArmView](), list[BoardView](), set[tuple[int, int]]()
    misses = list[InputError]()
    for share, arm, image in source.read(max_views):
        on_share(share)
        sizes.add((image.shape[1], image.shape[0]))
        if len(sizes) > 1:
            named = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
            hint = "give images of one camera"
            raise InputError(f"has images of {named}.", file=source.source, field="views", hint=hint)
        try:
            board = board.completed(image)
        except InputError as error:  # the board may be in a later image
            misses.append(error)
            if len(misses) == _MOST_MISSES:
                break
            continue
        arms.append(arm)
        views.append(board.detect(image))
    if misses and not views:
        raise misses[-1]
    if not sizes:
        hint = "give a folder of images or a log"
        raise InputError("has no images.", file=source.source, field="views", hint=hint)
    return BoardRecording(arms, views, sizes.pop())


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
    return open_log(source, camera=replace(recorded, camera=recorded.camera.pinhole))


def _beside(image: Path) -> ArmView:
    """Read the file next to an image."""
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
        return ArmView(joints, _pose(path, found))
    return ArmView()


def _pose(path: Path, found: dict[str, Any]) -> Array | None:
    if "T_base_link" in found:
        T = _numbers(path, "T_base_link", found["T_base_link"], (4, 4))
        if np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
            hint = "write rows, not columns: transpose the O_T_EE of a Franka robot"
            raise FormatError("has a last row other than 0 0 0 1.", file=path, field="T_base_link", hint=hint)
    elif "r_mtx" in found and "t_vec" in found:
        R = _numbers(path, "r_mtx", found["r_mtx"], (-1,))
        if len(R) not in (9, 16):
            raise FormatError(f"has {len(R)} numbers.", file=path, field="r_mtx", hint="give 3 rows of 3 or 4 of 4")
        T = np.eye(4)
        T[:3, :3] = R.reshape(3 if len(R) == 9 else 4, -1)[:3, :3]
        T[:3, 3] = _numbers(path, "t_vec", found["t_vec"], (3,))
    else:
        return None
    R = nearest_rotation(T[:3, :3])
    if np.abs(R - T[:3, :3]).max() > 1e-3:
        raise FormatError("is no rotation.", file=path, field="pose", hint=f"write {_LAYOUT}")
    T[:3, :3] = R
    return T


def _numbers(path: Path, name: str, value: object, shape: tuple[int, ...]) -> Array:
    try:
        numbers = np.asarray(value, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all():
        raise FormatError("holds no finite numbers of that shape.", file=path, field=name, hint=f"write {_LAYOUT}")
    return numbers
