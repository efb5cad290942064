"""A colour file and a depth file become a Frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.logs.base import LogBase
from splatbot.logs.calibration import Calibration
from splatbot.logs.images import read_color, read_depth
from splatbot.logs.undistort import Undistorter


@dataclass(frozen=True)
class DepthUnitConstants:
    """Constants of the recognition of depth units.

    Args:
        min_median: [m] no RGB-D sensor's median depth is smaller.
        max_median: [m] no RGB-D sensor's median depth is larger.
        typical_median: [m] median depth of most logs.
    """

    min_median: float = 0.05
    max_median: float = 50.0
    typical_median: float = 1.5


CONSTANTS = DepthUnitConstants()


_SCALES = (1.0, 100.0, 1000.0, 5000.0, 6553.5, 10000.0)  # units per metre in use


class RgbdReader:
    """Reads the images of one calibrated camera; frames are undistorted and their depth is in metres.

    Args:
        calibration: the camera and the unit of its depth.
        empty_depth: accept depth images without a valid pixel, as from a simulated blackout.
    """

    def __init__(self, calibration: Calibration, *, empty_depth: bool = False) -> None:
        self.calibration = calibration
        self._empty_depth = empty_depth
        self._undistort = Undistorter(calibration.camera) if calibration.camera.distortion else None
        self.camera: Camera = calibration.camera.pinhole

    def read(self, index: int, stamp: float, color: Path, depth: Path, mask: NDArray[np.bool_] | None = None) -> Frame:
        """Read a frame from two files; ``mask`` (H, W) refers to the distorted image.

        Raises:
            LogError: a file is damaged, sizes differ, there is no valid depth, or (frame 0) its unit is implausible.
        """
        rgb = read_color(color)
        z = read_depth(depth, self.calibration.depth_scale, empty=self._empty_depth)
        return self.frame(index, stamp, rgb, z, color, depth, mask)

    def frame(
        self,
        index: int,
        stamp: float,
        rgb: NDArray[np.uint8],
        z: NDArray[np.float32],
        color: Path,
        depth: Path,
        mask: NDArray[np.bool_] | None = None,
    ) -> Frame:
        """Build a frame of decoded images; ``color`` and ``depth`` name their files in errors.

        Raises:
            LogError: sizes differ, or (frame 0) the unit of depth is implausible.
        """
        self._check_sizes(rgb, z, color, depth)
        if mask is not None and mask.shape != z.shape:
            raise LogError(
                f"the mask is {mask.shape[1]}x{mask.shape[0]}, the image {z.shape[1]}x{z.shape[0]}.",
                file=color,
                field="mask size",
                hint="write masks at the colour image's size",
            )
        if index == 0 and z.any():
            self._check_unit(z, depth)
        if self._undistort:
            rgb, z = self._undistort.color(rgb), self._undistort.depth(z)
            mask = None if mask is None else self._undistort.mask(mask)
        try:
            return Frame(stamp, rgb, z, self.camera, index, mask=mask, source=str(color))
        except InputError as error:
            raise LogError(error.message, file=depth, field=error.field, hint=error.hint) from error

    def _check_sizes(self, rgb: NDArray[np.uint8], z: NDArray[np.float32], color: Path, depth: Path) -> None:
        seen, camera = (rgb.shape[1], rgb.shape[0]), self.calibration.camera
        if seen != (z.shape[1], z.shape[0]):
            raise LogError(
                f"is {z.shape[1]}x{z.shape[0]}, its colour image {color.name} is {seen[0]}x{seen[1]}.",
                file=depth,
                field="depth size",
                hint="register depth to colour, at the colour image's size",
            )
        if seen != (camera.width, camera.height):
            where = self.calibration.file or "the intrinsics"
            raise LogError(
                f"is {seen[0]}x{seen[1]}, {where} says {camera.width}x{camera.height}.",
                file=color,
                field="image size",
                hint="give the intrinsics of this image size (width, height and fx, fy, cx, cy with them)",
            )

    def _check_unit(self, z: NDArray[np.float32], depth: Path) -> None:
        median = float(np.median(z[z > 0]))
        if CONSTANTS.min_median <= median <= CONSTANTS.max_median:
            return
        units = median * self.calibration.depth_scale
        likely = min(_SCALES, key=lambda scale: abs(np.log(units / scale / CONSTANTS.typical_median)))
        raise LogError(
            f"is {self.calibration.depth_scale:g}, which makes the median depth of {depth.name} {median:.4g} m.",
            file=self.calibration.file or depth,
            field="depth_scale",
            hint=f"depth_scale is units per metre; {likely:g} would make it {units / likely:.3g} m",
        )


class ReaderLog(LogBase):
    """The common part of logs whose frames ``_reader`` builds."""

    _reader: RgbdReader

    @property
    def camera(self) -> Camera:
        """Camera of the delivered frames: undistorted."""
        return self._reader.camera

    @property
    def calibration(self) -> Calibration:
        """Calibration of the recorded images."""
        return self._reader.calibration


class FolderLog(ReaderLog):
    """The common part of logs whose images lie in a folder.

    Args:
        folder: of the log.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.uri = str(folder)
        self.name = self.folder.resolve().name
