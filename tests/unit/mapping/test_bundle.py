"""Bundle adjustment: covisible pairs correct drift, a wrong pair does not, and fixed keyframes stay."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.config import BundleConfig
from splatbot.geometry import inverse, se3_exp
from splatbot.mapping.bundle import adjust, variance_ratio
from splatbot.mapping.posegraph import Edge, PoseGraph, orthonormal
from splatbot.tracking.nearby_keyframes import pose_distance
from tests.rgbd import Array

TIGHT = np.diag([1e-3**2] * 6)


def drifted(count: int, drift: float) -> tuple[PoseGraph, dict[int, Array]]:
    """Return keyframes of a camera that turns to and fro, with poses that drift, and their true poses."""
    graph, truth = PoseGraph(), {}
    wrong = se3_exp(drift * np.array([1.0, -0.5, 0.7, 0.2, 0.4, -0.3]))
    D = np.eye(4)
    for k in range(count):
        angle = 0.3 * np.sin(0.4 * k)
        truth[k] = se3_exp([0.1 * np.sin(0.3 * k), 0.0, 0.02 * np.cos(0.5 * k), 0.0, angle, 0.0])
        if k:
            D = D @ inverse(truth[k - 1]) @ truth[k] @ wrong
        graph.poses[k] = truth[0] @ D
    return graph, truth


def connect(graph: PoseGraph, truth: dict[int, Array], pairs: list[tuple[int, int]]) -> None:
    """Add exact covisible pairs."""
    graph.edges += [Edge(a, b, inverse(truth[a]) @ truth[b], TIGHT, covisible=True) for a, b in pairs]


def test_covisible_pairs_remove_the_drift_and_half_of_wrong_ones_does_not_bend_it() -> None:
    graph, truth = drifted(20, 3e-3)
    assert pose_distance(graph.poses[19], truth[19])[0] > 0.03
    connect(graph, truth, [(a, b) for b in range(20) for a in range(b) if b - a in (1, 2, 9)])
    graph.edges.append(Edge(3, 19, se3_exp([0.5, 0.0, 0.0, 0.0, 0.3, 0.0]), TIGHT, covisible=True))
    correction = adjust(graph, 19, BundleConfig()).correction
    assert correction is not None
    worst = max(pose_distance(correction[k] @ graph.poses[k], truth[k])[0] for k in truth)
    assert worst < 1e-3


def test_without_a_revisit_only_the_window_moves() -> None:
    graph, truth = drifted(20, 3e-3)
    connect(graph, truth, [(k - 1, k) for k in range(1, 20)])
    correction = adjust(graph, 19, BundleConfig(window=4)).correction
    assert correction is not None
    assert all(np.array_equal(correction[k], np.eye(4)) for k in range(16))
    before, after = pose_distance(graph.poses[15], graph.poses[19]), inverse(truth[15]) @ truth[19]
    moved = inverse(graph.poses[15]) @ correction[19] @ graph.poses[19]
    assert pose_distance(after, moved)[0] < 1e-4 < before[0]


def test_consistent_poses_are_not_corrected() -> None:
    graph, truth = drifted(12, 0.0)
    connect(graph, truth, [(a, b) for b in range(12) for a in range(b)])
    adjustment = adjust(graph, 11, BundleConfig())
    assert adjustment.correction is None
    assert adjustment.variance_ratio == pytest.approx(0.0, abs=1e-9)


def test_a_keyframe_without_pairs_has_no_variance_ratio() -> None:
    graph, truth = drifted(5, 3e-3)
    connect(graph, truth, [(0, 1), (1, 2), (2, 3)])
    graph.edges.append(Edge(3, 4, inverse(truth[3]) @ truth[4], TIGHT))
    assert adjust(graph, 4, BundleConfig()).variance_ratio is None


def test_the_variance_ratio_of_errors_that_their_covariance_describes_is_one(rng: np.random.Generator) -> None:
    sigma = 2e-3
    noise = sigma * rng.normal(size=(4000, 6))
    poses = {0: np.eye(4), 1: np.eye(4)}
    ratios = [variance_ratio(Edge(0, 1, se3_exp(n), sigma**2 * np.eye(6)), poses) for n in noise]
    assert np.mean(ratios) == pytest.approx(1.0, rel=0.05)


def test_hundreds_of_corrections_keep_rotations_exact(rng: np.random.Generator) -> None:
    """A plain product of pose and inverse doubles its rounding error with each correction."""
    T = se3_exp(rng.normal(size=6))
    for _ in range(300):
        new = orthonormal(T @ se3_exp(1e-3 * rng.normal(size=6)))
        T = orthonormal(orthonormal(new @ inverse(T)) @ T)
    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-14
