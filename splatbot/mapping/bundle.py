"""Bundle adjustment: the poses of keyframes that fit all alignments of covisible pairs best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.config import BundleConfig
from splatbot.geometry import inverse
from splatbot.mapping.posegraph import Edge, PoseGraph, drift_covariance, orthonormal
from splatbot.tracking.nearby_keyframes import pose_distance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BundleConstants:
    """Constants of bundle adjustment.

    Args:
        least_sigma: [m], [rad] standard deviation of any alignment in the comparison of pairs.
    """

    least_sigma: float = 1e-4


CONSTANTS = BundleConstants()


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Result of a bundle adjustment.

    Args:
        correction: T_new_old (4, 4) of all keyframes; None if the poses hardly change.
        variance_ratio: ratio of the observed to the stated variance of the new keyframe's alignments. None if it has no
            covisible pair.
    """

    correction: dict[int, Array] | None
    variance_ratio: float | None


def adjust(graph: PoseGraph, number: int, config: BundleConfig) -> Adjustment:
    """Adjust the poses of the latest keyframes to all pairs that see the same place.

    Each edge of the graph holds the alignment of a pair in condensed form: a motion and its covariance. The motion
    minimizes the reprojection, photometric and depth residuals of the two images. So the problem has six unknowns for
    each keyframe and no landmarks, as in BundleFusion (Dai et al. 2017) and DVO-SLAM (Kerl et al. 2013). Keyframes
    before the window are fixed. If the new keyframe sees a place from before the window, all keyframes but the first
    move.

    Args:
        graph: poses and edges; not changed.
        number: of the new keyframe.
        config: settings of bundle adjustment.
    """
    window = sorted(graph.poses)[-config.window :]
    revisits = any(edge.second == number and edge.first < window[0] for edge in graph.edges)
    free = set(graph.poses if revisits else window) - {min(graph.poses)}
    poses = graph.poses | {k: T for k, T in graph.optimize(free).items() if k in free}
    pairs = [e for e in graph.edges if e.covisible and e.second == number]
    ratio = float(np.mean([variance_ratio(edge, poses) for edge in pairs])) if pairs else None
    moved = [pose_distance(graph.poses[k], poses[k]) for k in free]
    if all(m < config.min_translation and t < config.min_rotation for m, t in moved):
        return Adjustment(None, ratio)
    correction = {k: orthonormal(poses[k] @ inverse(T)) if k in free else np.eye(4) for k, T in graph.poses.items()}
    return Adjustment(correction, ratio)


def variance_ratio(edge: Edge, poses: dict[int, Array]) -> float:
    """Compute rᵀ Σ⁻¹ r / 6 of an edge, with the covariance Σ of its alignment alone, without the drift of a path.

    Its mean is the squared Birge ratio (Birge 1932). It exceeds 1 if images contradict each other by more than their
    residuals show: by a rolling shutter, blur, or depth of another instant.
    """
    covariance = edge.covariance - drift_covariance(edge.T_first_second) + CONSTANTS.least_sigma**2 * np.eye(6)
    residual = edge.residual(poses)
    return float(residual @ np.linalg.solve(covariance, residual)) / 6
