"""Health of a pose: a score to select the best hypothesis, and a verdict with reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.geometry import inverse
from splatbot.tracking.align import residuals
from splatbot.tracking.degeneracy import WeakDirections
from splatbot.tracking.prepare import Level
from splatbot.tracking.reference import Reference

Array = NDArray[np.float64]
Verdict = Literal["ok", "degraded", "lost"]


@dataclass(frozen=True)
class HealthConstants:
    """Empirical thresholds of the verdict."""

    saturation: float = 6.0
    """Largest residual [σ] in the score. A missing residual has this value too."""
    inlier: float = 3.0
    """Largest residual [σ] of an inlier. A larger value accepts more wrong poses."""
    min_contrast: float = 0.1
    """Share [1] of the reference's contrast below which an image is blank: a covered lens, or darkness. The exposure
    fit would explain such an image at any pose by a gain of almost 0."""
    min_photometric: float = 0.55
    """Share [1] of photometric inliers below which a pose is degraded. On a plane, depth agrees at any pose
    along it."""
    min_edge: float = 0.5
    """Share [1] of photometric inliers, weighted by the gradient, below which a pose is degraded. Pixels without
    texture agree at most poses."""
    explained: float = 0.6
    """Share [1] of inliers of each kind from which no other pose is searched for."""


CONSTANTS = HealthConstants()


@dataclass(frozen=True)
class Health:
    """Agreement of a pose with the frame.

    Args:
        overlap: share of the reference points that the frame observes, by colour or depth.
        photometric_inliers: share of them whose grey agrees within 3 σ.
        edge_inliers: the same share, with each point weighted by its gradient of grey. It is 1 without gradients.
        geometric_inliers: share of the points with depth whose depth agrees within 3 σ. It is 1 without depth.
        score: mean saturated residual [σ]. Smaller is better. It is comparable between poses of one frame.
        contrast: standard deviation of the frame's grey at the points, relative to that of the reference. It is 1 if
            the reference has a single grey.
    """

    overlap: float
    photometric_inliers: float
    edge_inliers: float
    geometric_inliers: float
    score: float
    contrast: float


def is_explained(health: Health) -> bool:
    """Return True if a pose explains the frame, so that no other pose is searched for."""
    inliers = min(health.photometric_inliers, health.edge_inliers, health.geometric_inliers)
    return inliers >= CONSTANTS.explained


def measure(
    level: Level, index: int, references: Sequence[Reference], T_world_camera: Array, config: TrackingConfig
) -> Health:
    """Measure the health of a pose against references on one level, with the exposure fitted to each of them.

    Args:
        level: level of the frame's pyramid.
        index: index of this level.
        references: sampled pixels of the keyframes.
        T_world_camera: (4, 4).
        config: settings of tracking.
    """
    T_camera_world = inverse(T_world_camera)
    photo, depth, slope, here, there = [], [], [], [], []
    for reference in references:
        points = reference.levels[index]
        found = residuals(level, points, T_camera_world @ reference.T_world_camera, config)
        photo.append(np.abs(found.photometric))
        depth.append(np.abs(found.geometric))
        slope.append(points.slope)
        seen = np.isfinite(found.photometric)
        there.append(points.gray[seen].astype(np.float64))
        here.append(found.photometric[seen] * config.sensor.sigma_gray + found.gain * there[-1] + found.offset)
    r_photo, r_depth = np.concatenate(photo), np.concatenate(depth)
    seen, ranged = np.isfinite(r_photo), np.isfinite(r_depth)
    agree, steep = r_photo[seen] < CONSTANTS.inlier, np.concatenate(slope)[seen].astype(np.float64)
    return Health(
        overlap=float(seen.mean()) if len(seen) else 0.0,
        photometric_inliers=float(agree.mean()) if len(agree) else 0.0,
        edge_inliers=float(steep @ agree / steep.sum()) if steep.sum() > 0 else 1.0,
        geometric_inliers=float((r_depth[ranged] < CONSTANTS.inlier).mean()) if ranged.any() else 1.0,
        score=float(np.mean([_saturated(r_photo), _saturated(r_depth)])) if len(seen) else CONSTANTS.saturation,
        contrast=_contrast(np.concatenate(here), np.concatenate(there)),
    )


def _saturated(residuals: NDArray[np.floating[Any]]) -> float:
    return float(np.fmin(residuals, CONSTANTS.saturation).mean())  # fmin replaces NaN by the saturation


def _contrast(gray: Array, reference_gray: Array) -> float:
    """Compute the ratio of the standard deviations of grey values (N,), or 1 if the reference has a single grey."""
    spread = float(reference_gray.std()) if len(reference_gray) else 0.0
    return float(gray.std()) / spread if spread > 1e-6 else 1.0


def verdict_of(
    health: Health, information: Array, weak: WeakDirections | None, config: TrackingConfig
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict of a pose and its reasons.

    Args:
        health: agreement of the pose with the frame.
        information: (6, 6) of the alignment.
        weak: directions that the frame does not constrain. If None, it constrains all of them.
        config: settings of tracking.
    """
    lost, doubts = [], []
    # The negated comparisons are True for NaN.
    if not health.overlap >= config.min_overlap:
        lost.append(f"only {health.overlap:.0%} of the reference is seen")
    inliers = float(np.min([health.photometric_inliers, health.geometric_inliers]))
    if not inliers >= config.min_inliers:
        lost.append(f"only {inliers:.0%} of the residuals are inliers")
    if not health.contrast >= CONSTANTS.min_contrast:
        lost.append(f"the image is blank: {health.contrast:.0%} of the reference's contrast")
    if not health.photometric_inliers >= CONSTANTS.min_photometric:
        doubts.append(f"only {health.photometric_inliers:.0%} of the colours agree")
    elif not health.edge_inliers >= CONSTANTS.min_edge:
        doubts.append(f"only {health.edge_inliers:.0%} of the colours agree where there are edges")
    if not np.isfinite(information).all():
        lost.append("the alignment is not finite")
    elif weak is not None:
        doubts.append(weak.reason)
    if lost:
        return "lost", tuple(lost)
    return ("degraded", tuple(doubts)) if doubts else ("ok", ())
