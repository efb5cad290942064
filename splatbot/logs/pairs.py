"""Logs of single image files: each colour image has a depth image of the same number."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs.base import StampedLog
from splatbot.logs.calibration import Calibration
from splatbot.logs.images import read_color, read_depth
from splatbot.logs.poses import reference
from splatbot.logs.registration import ColorRegistration
from splatbot.logs.rgbd import FolderLog, RgbdReader
from splatbot.trajectory import Trajectory

RATE = 30.0  # [Hz] of layouts without stamps

_NO_DEPTH = 65_535  # of integer depth images, like 0
_MAX_DIGITS = 12  # of a frame number, so that stamps stay exact

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImagePair:
    """Images of one frame: the number in their names, the files of colour and depth."""

    number: int
    color: Path
    depth: Path


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Return the files of a folder whose whole name matches, by the number that the pattern's group ``n`` takes.

    Raises:
        LogError: the folder cannot be read, two files have one number, or a number has more than 12 digits.
    """
    found: dict[int, Path] = {}
    try:
        paths = sorted(folder.iterdir())
    except OSError as error:
        raise LogError(f"cannot be read ({error.strerror}).", file=folder, hint="check the folder") from error
    for path in paths:
        match = re.fullmatch(pattern, path.name, re.IGNORECASE | re.ASCII)
        if match is None:
            continue
        if len(match["n"]) > _MAX_DIGITS:
            raise LogError("has too many digits.", file=path, field="name", hint="number the images from 0")
        other = found.setdefault(int(match["n"]), path)
        if other != path:
            raise LogError(f"has the number of {other.name}.", file=path, field="name", hint="remove one of both")
    return found


def name_order(name: str) -> list[tuple[int, str]]:
    """Return a key that orders names by their numbers: 2 before 10."""
    parts = re.split(r"([0-9]+)", name)
    return [(len(part.lstrip("0")), part.lstrip("0") or part) if i % 2 else (0, part) for i, part in enumerate(parts)]


def stamps_of_names(folder: Path, names: Sequence[str]) -> list[float]:
    """Return stamps [s] of images in their order: the seconds in all names, as 12.345.png, or n / 30 s.

    Raises:
        LogError: the names are seconds that do not increase.
    """
    found = [re.fullmatch(r"(\d{1,12}\.\d{1,9})\.[a-z]+", name, re.IGNORECASE | re.ASCII) for name in names]
    seconds = [float(match[1]) for match in found if match is not None]
    if len(seconds) < len(names):
        return [n / RATE for n in range(len(names))]
    if any(a >= b for a, b in pairwise(seconds)):
        hint = "give each image its own time, all with as many decimals"
        raise LogError("does not increase.", file=folder, field="seconds in names", hint=hint)
    return seconds


def pair_files(folder: Path, colors: dict[int, Path], depths: dict[int, Path]) -> tuple[list[ImagePair], int]:
    """Return the pairs of equal numbers in their order, and the count of images without a partner, which is logged.

    Raises:
        LogError: there is no pair.
    """
    pairs = [ImagePair(n, colors[n], depths[n]) for n in sorted(colors.keys() & depths.keys())]
    if not pairs:
        raise LogError(
            f"the log is empty: {len(colors)} colour and {len(depths)} depth images have no number in common.",
            file=folder,
            field="images",
            hint="give the colour image and the depth image of a frame the same number",
        )
    unpaired = len(colors) + len(depths) - 2 * len(pairs)
    if unpaired:
        _log.warning("%s: %d images have no partner of the same number", folder, unpaired)
    return pairs, unpaired


class PairLog(FolderLog, StampedLog):
    """The common part of logs of paired images; 0 and 65535 mark missing depth in integer images.

    Args:
        folder: of the log.
        pairs: images of the frames, in their order.
        stamps: times of the frames [s], increasing.
        calibration: of the depth images, and of the colour images without a ``registration``.
        registration: resamples colour at the depth pixels.
    """

    def __init__(
        self,
        folder: str | Path,
        pairs: Sequence[ImagePair],
        stamps: list[float],
        calibration: Calibration,
        registration: ColorRegistration | None = None,
    ) -> None:
        super().__init__(folder)
        self._pairs, self.stamps = pairs, stamps
        self._reader, self._registration = RgbdReader(calibration), registration

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Poses T_world_camera at the stamps of the frames; frames whose pose is missing, not finite or not rigid lack.

        Raises:
            LogError: a file of a pose does not hold 16 numbers.
        """
        return reference(self.stamps, self._poses())

    def _poses(self) -> Iterable[NDArray[np.float64] | None]:
        """Return T_world_camera (4, 4) of each frame, or None."""
        raise NotImplementedError

    def _decode(self, index: int) -> Frame:
        pair = self._pairs[index]
        rgb = read_color(pair.color)
        z = read_depth(pair.depth, self.calibration.depth_scale, void=_NO_DEPTH)
        if self._registration is not None:
            rgb, z = self._registration.register(rgb, z, pair.color)
        return self._reader.frame(index, self.stamps[index], rgb, z, pair.color, pair.depth)
