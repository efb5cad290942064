"""Is this pose to be believed? A score to choose between candidates and a verdict with reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.geometry import inverse
from splatbot.tracking.align import residuals
from splatbot.tracking.prepare import Level
from splatbot.tracking.reference import Reference

Array = NDArray[np.float64]
Verdict = Literal["ok", "degraded", "lost"]

_SATURATION = 6.0  # a residual of this many σ, or none at all, counts as an outlier
_INLIER = 3.0  # [σ]


@dataclass(frozen=True)
class Health:
    """How well a pose explains the frame.

    Args:
        overlap: share of the reference points that the frame sees, by colour or depth.
        photometric_inliers: share of those whose grey agrees within 3 σ.
        geometric_inliers: share of those with depth whose depth agrees within 3 σ; 1 where none has depth.
        score: mean residual [σ], saturated; smaller is better, comparable between poses of one frame.
    """

    overlap: float
    photometric_inliers: float
    geometric_inliers: float
    score: float


def measure(
    level: Level, index: int, references: Sequence[Reference], T_world_camera: Array, config: TrackingConfig
) -> Health:
    """Score a pose of a frame against references on one level; only exposure is fitted."""
    T_camera_world = inverse(T_world_camera)
    photo, depth = [], []
    for reference in references:
        T_camera_reference = T_camera_world @ reference.T_world_camera
        r_photo, r_depth = residuals(level, reference.levels[index], T_camera_reference, config)
        photo.append(np.abs(r_photo))
        depth.append(np.abs(r_depth))
    r_photo, r_depth = np.concatenate(photo), np.concatenate(depth)
    seen, ranged = np.isfinite(r_photo), np.isfinite(r_depth)
    return Health(
        overlap=float(seen.mean()) if len(seen) else 0.0,
        photometric_inliers=float((r_photo[seen] < _INLIER).mean()) if seen.any() else 0.0,
        geometric_inliers=float((r_depth[ranged] < _INLIER).mean()) if ranged.any() else 1.0,
        score=float(np.mean([_saturated(r_photo), _saturated(r_depth)])) if len(seen) else _SATURATION,
    )


def _saturated(residuals: NDArray[np.floating[Any]]) -> float:
    return float(np.minimum(np.nan_to_num(residuals, nan=_SATURATION), _SATURATION).mean())


def verdict_of(health: Health, information: Array, config: TrackingConfig) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict and what speaks against the pose."""
    lost, doubts = [], []
    if health.overlap < config.min_overlap:
        lost.append(f"only {health.overlap:.0%} of the reference is seen")
    inliers = min(health.photometric_inliers, health.geometric_inliers)
    if inliers < config.min_inliers:
        lost.append(f"only {inliers:.0%} of the residuals are inliers")
    eigenvalues = np.linalg.eigvalsh(information[:3, :3])
    if not eigenvalues[0] > config.min_eigen_ratio * eigenvalues[2]:
        doubts.append("translation is hardly constrained in one direction")
    if lost:
        return "lost", tuple(lost + doubts)
    return ("degraded", tuple(doubts)) if doubts else ("ok", ())
