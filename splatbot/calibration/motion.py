"""Matched features of the frames of a log, and the velocities of the camera between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.tracking.features import Features, match, match_pose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionConstants:
    """Constants of the motion between frames."""

    max_gap: float = 0.15
    """Longest time [s] between neighbouring frames with a velocity. A hand accelerates within longer ones."""
    steps: tuple[int, ...] = (1, 2, 4, 7, 11)
    """Distances [frames] of matched pairs. Far ones have another velocity, near ones more matches."""
    min_matches: int = 40
    """Matches [1] of a pair. Seven unknowns need some, and outliers are among them."""


CONSTANTS = MotionConstants()


@dataclass(frozen=True, eq=False)
class View:
    """A frame for calibration.

    Args:
        stamp: time [s].
        features: keypoints with depth.
    """

    stamp: float
    features: Features


@dataclass(eq=False)
class Pair:
    """Two views with matched features.

    Args:
        first: index of the first view.
        second: index of the second view.
        T_second_first: (4, 4), estimated.
        points: (N, 3) [m] of the features in the first view, without correction.
        pixels_first: (N, 2) of the features in the first view.
        pixels: (N, 2) of the features in the second view.
        sigmas: (N,) [px] standard deviations of the pixels.
    """

    first: int
    second: int
    T_second_first: Array
    points: Array
    pixels_first: Array
    pixels: Array
    sigmas: Array = field(repr=False)


def match_pairs(views: Sequence[View], camera: Camera) -> list[Pair]:
    """Match the features of views that are ``CONSTANTS.steps`` apart, with initial poses by PnP between neighbours."""
    chain: list[Array | None] = []  # T_next_previous
    for a, b in pairwise(views):
        pose = match_pose(b.features, [(a.features, np.eye(4))], camera)
        close = 0 < b.stamp - a.stamp <= CONSTANTS.max_gap
        chain.append(inverse(pose.T_world_camera) if pose is not None and close else None)
    pairs = []
    for step in CONSTANTS.steps:
        for i in range(len(views) - step):
            T = np.eye(4)
            links = chain[i : i + step]
            for link in links:
                T = T if link is None else link @ T
            if all(link is not None for link in links):
                pair = _match_pair(views, i, i + step, T)
                if len(pair.pixels) >= CONSTANTS.min_matches:
                    pairs.append(pair)
    return pairs


def _match_pair(views: Sequence[View], first: int, second: int, T_second_first: Array) -> Pair:
    a, b = views[first].features, views[second].features
    known = np.flatnonzero(np.isfinite(a.points[:, 2]))
    query, train = match(b, a.descriptors[known], np.zeros((len(known), 2), np.float32), np.inf)
    chosen = known[train]
    return Pair(
        first,
        second,
        T_second_first,
        a.points[chosen],
        a.pixels[chosen].astype(np.float64),
        b.pixels[query].astype(np.float64),
        np.maximum(b.scales[query], a.scales[chosen]).astype(np.float64),
    )


def velocities(views: Sequence[View], pairs: Sequence[Pair]) -> dict[int, Array]:
    """Return the twist (6,) [m/s, rad/s] at each view with both neighbours, as the mean of the motions to them."""
    twists = {
        pair.first: se3_log(inverse(pair.T_second_first)) / (views[pair.second].stamp - views[pair.first].stamp)
        for pair in pairs
        if pair.second == pair.first + 1
    }
    return {k: 0.5 * (twists[k - 1] + twists[k]) for k in twists if k - 1 in twists}


def moved(points: Array, seconds: Array, twist: Array) -> Array:
    """Return points (N, 3) [m] of a camera at times (N,) [s] in the camera at time 0: exp(s ξ) X to third order."""
    s = seconds[:, None]
    a = twist[:3] + np.cross(twist[3:], points)
    b = np.cross(twist[3:], a)
    return np.asarray(points + s * (a + s / 2 * (b + s / 3 * np.cross(twist[3:], b))))


def updated(T_second_first: Array, step: Array) -> Array:
    """Return a pose (4, 4) after a left increment (6,)."""
    return np.asarray(se3_exp(step) @ T_second_first)
