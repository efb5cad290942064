"""Rectangle around surface points of an object that cameras saw from one side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.protocols import Array


@dataclass(frozen=True)
class RectangleConstants:
    """Constants of the fit of a rectangle.

    Args:
        steps: number of directions in a quarter turn that are tried.
        max_points: largest number of points that determine the direction, evenly spaced.
        near: [m] distance from an edge below which a point counts fully.
        trim: [%] share of points outside of the rectangle on each side; fewer points follow outliers.
    """

    steps: int = 90
    max_points: int = 1000
    near: float = 2e-3
    trim: float = 1.0


CONSTANTS = RectangleConstants()


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A rectangle in the plane.

    Args:
        center: (2,) middle [m].
        sides: (2,) lengths along its two axes [m].
        yaw: direction of its first axis [rad], in 0..π/2.
    """

    center: Array
    sides: Array
    yaw: float


def fit_rectangle(points: Array) -> Rectangle:
    """Fit a rectangle to points (P, 2) [m] on the faces of an object, as seen from above.

    A camera sees two faces of a box, an L. The smallest rectangle around an L may lie along its diagonal. The direction
    is that with the most points near edges. It has the largest Σ 1 / max(d, d₀), with the distance d of a point from
    the nearest edge. This is the closeness criterion of Zhang et al., "Efficient L-Shape Fitting for Vehicle Detection
    Using Laser Scanners", IV 2017.
    """
    some = points[np.linspace(0, len(points) - 1, min(len(points), CONSTANTS.max_points)).round().astype(np.int64)]
    yaws = np.arange(CONSTANTS.steps) * (np.pi / 2 / CONSTANTS.steps)
    axes = np.stack([[np.cos(yaws), np.sin(yaws)], [-np.sin(yaws), np.cos(yaws)]])  # (2 axes, 2, steps)
    along = np.einsum("pd,ads->asp", some, axes)
    low, high = np.percentile(along, [CONSTANTS.trim, 100 - CONSTANTS.trim], axis=2)[..., None]
    away = np.minimum(np.abs(along - low), np.abs(along - high)).min(axis=0)
    best = int(np.argmax((1.0 / np.maximum(away, CONSTANTS.near)).sum(axis=1)))
    frame = axes[:, :, best]
    ends = np.percentile(points @ frame.T, [CONSTANTS.trim, 100 - CONSTANTS.trim], axis=0)
    return Rectangle(ends.mean(axis=0) @ frame, ends[1] - ends[0], float(yaws[best]))
