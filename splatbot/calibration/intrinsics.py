"""Intrinsics of a camera from views of a board (Zhang, A flexible new technique for camera calibration, 2000)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.board import MIN_CORNERS, BoardView
from splatbot.calibration.estimate import Estimate
from splatbot.camera import Camera
from splatbot.errors import InputError

Array = NDArray[np.float64]

MIN_VIEWS = 6
"""Least number of views [1]: of fewer, one bad view changes the focal length by percents."""
_UNITS = {"fx": "px", "fy": "px", "cx": "px", "cy": "px", "k1": "", "k2": "", "p1": "", "p2": "", "k3": ""}
_LARGEST_SIGMA = 0.01  # [1] of the width of the image: by which a pixel at its corner may be off
_LARGEST_RMS = 1 / 640  # [1] of the width of the image


@dataclass(frozen=True, eq=False)
class IntrinsicsCalibration:
    """Estimated camera.

    Args:
        camera: camera with OpenCV's distortion (k1, k2, p1, p2, k3).
        estimates: each value with its standard deviation.
        rms: root mean square of the reprojection errors [px].
        views: root mean square of each view [px].
        corners: number of corners.
    """

    camera: Camera
    estimates: dict[str, Estimate]
    rms: float
    views: Array
    corners: int

    def check(self) -> None:
        """Check that the views determine each value.

        Raises:
            InputError: they do not.
        """
        for name, estimate in self.estimates.items():
            if estimate.refusal:
                hint = "take more images, with the board tilted by 20 to 40 degrees and up to the corners of the image"
                raise InputError(f"is not determined: {estimate.refusal}.", field=name, hint=hint)


def calibrate_intrinsics(views: Sequence[BoardView], size: tuple[int, int]) -> IntrinsicsCalibration:
    """Estimate focal lengths, principal point and distortion by least squares of the reprojection errors.

    A standard deviation is that of the least squares. Half the difference of the fits to the odd and to the even views
    replaces it if this is larger. Where the views do not determine a value, that of the least squares is meaningless.

    Args:
        views: views of one board; those with fewer than 8 corners are left out.
        size: width and height of the images [px].

    Raises:
        InputError: fewer than 6 views show the board, or they do not determine the camera.
    """
    chosen = [view for view in views if view.usable]
    if len(chosen) < MIN_VIEWS:
        raise InputError(
            f"{len(chosen)} of {len(views)} images show {MIN_CORNERS} corners of the board or more.",
            field="views",
            hint=f"take {MIN_VIEWS} images or more, 20 from different sides and distances are usual",
        )
    rms, values, sigma, errors = _fit(chosen, size)
    halves = [_fit(chosen[k::2], size)[1] for k in (0, 1)]
    sigma = np.maximum(sigma, 0.5 * np.abs(halves[0] - halves[1]))
    if rms > _LARGEST_RMS * size[0]:
        raise InputError(
            f"do not fit the model: {rms:.2f} px RMS.",
            field="views",
            hint="check the numbers of squares and the side of a square; the model is no fisheye lens",
        )
    corner = 0.5 * float(np.hypot(*size)) / values[0]  # [1] distance from the axis
    powers = np.array([corner**3, corner**5, 3 * corner**2, 3 * corner**2, corner**7])
    displacement = np.concatenate([[corner, corner, 1.0, 1.0], values[0] * powers])  # [px] there, for a change of 1
    need = "tilt the board more against the image, and fill the corners of the image"
    estimates = {
        name: Estimate.limited(float(v), float(s), unit, _LARGEST_SIGMA * size[0] / float(d), need)
        for (name, unit), v, s, d in zip(_UNITS.items(), values, sigma, displacement, strict=True)
    }
    fx, fy, cx, cy, *distortion = (float(value) for value in values)
    camera = Camera(fx, fy, cx, cy, *size, tuple(distortion))
    return IntrinsicsCalibration(camera, estimates, rms, errors, sum(map(len, chosen)))


def _fit(views: Sequence[BoardView], size: tuple[int, int]) -> tuple[float, Array, Array, Array]:
    """Return the RMS error [px], the values (9,), their standard deviations (9,) and the RMS error of each view."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    try:
        rms, K, D, _, _, sigma, _, errors = cv2.calibrateCameraExtended(points, pixels, size, None, None)  # type: ignore[call-overload]
    except cv2.error as error:
        raise InputError(
            f"do not determine the camera ({error.err}).", field="views", hint="tilt the board against the image"
        ) from error
    values = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.reshape(D, -1)[:5]])
    return float(rms), values, np.reshape(sigma, -1)[:9].astype(np.float64), np.reshape(errors, -1)
