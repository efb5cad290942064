"""NEES: 1 for errors that are as large as their covariances say."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.evaluation import nees
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.trajectory import Trajectory

SIGMAS = np.array([1e-3, 2e-3, 3e-3, 1e-3, 2e-3, 5e-4])


def trajectories(n: int, seed: int, scale: float = 1.0) -> tuple[Trajectory, Trajectory, np.ndarray]:
    """Return a path, the same path from its first pose with random errors, and the covariances of the errors."""
    rng, stamps = np.random.default_rng(seed), np.arange(n) / 30
    truth = np.array([se3_exp([0.01 * i, 0.002 * i, -0.005 * i, 0.01 * i, 0, 0.02 * i]) for i in range(n)])
    world = se3_exp([1, 2, 3, 0.1, 0.2, 0.3])
    poses = truth.copy()
    for i in range(1, n):
        poses[i] = truth[i] @ se3_exp(-scale * SIGMAS * rng.standard_normal(6))
    return Trajectory(stamps, world @ truth), Trajectory(stamps, poses), np.tile(np.diag(SIGMAS**2), (n, 1, 1))


def test_right_covariances_have_a_nees_of_one_whatever_frame_the_reference_is_in() -> None:
    found = nees(*trajectories(3000, 0))
    assert found.mean == pytest.approx(1.0, abs=0.03)
    assert found.median == pytest.approx(0.891, abs=0.03)
    assert len(found.values) == 2999


def test_errors_twice_as_large_have_four_times_the_nees() -> None:
    assert nees(*trajectories(1000, 1, 2.0)).mean == pytest.approx(4 * nees(*trajectories(1000, 1)).mean, rel=0.05)


def test_errors_of_the_reference_itself_are_taken_into_account() -> None:
    reference, estimate, covariances = trajectories(1000, 2, 2.0)
    assert nees(reference, estimate, covariances, reference_covariance=3 * np.diag(SIGMAS**2)).mean == pytest.approx(
        1.0, abs=0.05
    )


def test_a_camera_that_sits_askew_on_the_tracked_body_is_fitted() -> None:
    rng, t = np.random.default_rng(4), np.arange(400) / 30
    turns = [0.5 * np.sin(t), 0.4 * np.sin(1.7 * t), 0.6 * np.sin(0.6 * t)]
    truth = np.array([se3_exp(twist) for twist in np.stack([0.1 * t, 0 * t, 0 * t, *turns], axis=1)])
    poses = np.array([T @ se3_exp(-SIGMAS * rng.standard_normal(6)) for T in truth])
    T_reference_camera = se3_exp([0.01, -0.005, 0.02, 0.02, -0.01, 0.015])
    body, estimate = Trajectory(t, truth @ inverse(T_reference_camera)), Trajectory(t, poses)
    covariances = np.tile(np.diag(SIGMAS**2), (400, 1, 1))
    assert nees(body, estimate, covariances).mean > 10
    found = nees(body, estimate, covariances, fit_mount=True)
    assert found.mean == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(found.T_reference_camera, T_reference_camera, atol=1e-3)


def test_a_motion_without_rotation_leaves_the_mount_as_it_is() -> None:
    """Any mount explains it, so the prior decides."""
    rng, stamps = np.random.default_rng(5), np.arange(300) / 30
    truth = np.array([se3_exp([0.01 * i, 0, 0, 0, 0, 0]) for i in range(300)])
    poses = np.array([T @ se3_exp(-SIGMAS * rng.standard_normal(6)) for T in truth])
    covariances = np.tile(np.diag(SIGMAS**2), (300, 1, 1))
    found = nees(Trajectory(stamps, truth), Trajectory(stamps, poses), covariances, fit_mount=True)
    assert np.linalg.norm(se3_log(found.T_reference_camera)) < 5e-3
    assert found.mean == pytest.approx(1.0, abs=0.1)


def test_a_reference_at_other_times_is_interpolated() -> None:
    """At 60 deg/s, the nearest of 100 poses a second is up to 0.3 degrees off."""

    def pose(t: float) -> np.ndarray:
        return se3_exp([0.3 * t, 0, 0, 0, 1.05 * t, 0])

    dense, stamps = np.arange(0, 5, 0.01), np.arange(0.0137, 4.9, 1 / 30)
    reference = Trajectory(dense, np.array([pose(t) for t in dense]))
    estimate = Trajectory(stamps, np.array([pose(t) for t in stamps]))
    covariances = np.tile(1e-10 * np.eye(6), (len(stamps), 1, 1))
    assert nees(reference, estimate, covariances).values.max() < 1e-6


def test_a_reference_with_many_samples_for_a_frame_counts_each_frame_once() -> None:
    """The reference covers a tenth of the time, so that it has fewer poses than the estimate has frames, or more."""
    _, estimate, covariances = trajectories(100, 6)
    covariances[0] = 0  # of the frame that defines the world
    stamps = np.arange(0, 0.333, 0.005)
    poses = np.array([se3_exp(30 * t * np.array([0.01, 0.002, -0.005, 0.01, 0, 0.02])) for t in stamps])
    found = nees(Trajectory(stamps, poses), estimate, covariances)
    assert len(found.stamps) == len(set(found.stamps)) == 10
    assert 0.2 < found.mean < 3


def test_a_mount_is_not_fitted_to_a_few_frames() -> None:
    reference, estimate, covariances = trajectories(10, 7)
    assert np.isfinite(nees(reference, estimate, covariances).mean)
    with pytest.raises(InputError, match="a fitted mount needs 10"):
        nees(reference, estimate, covariances, fit_mount=True)


def test_the_share_within_three_sigma_is_that_of_a_normal_distribution() -> None:
    assert nees(*trajectories(4000, 8)).within_three_sigma == pytest.approx(0.9973, abs=2e-3)


def test_covariances_that_cannot_be_are_refused() -> None:
    reference, estimate, covariances = trajectories(5, 3)
    with pytest.raises(InputError, match=r"have shape \(4, 6, 6\) for 5 poses"):
        nees(reference, estimate, covariances[1:])
    covariances[2, 0, 0] = -1
    with pytest.raises(InputError, match="not positive definite"):
        nees(reference, estimate, covariances)
    with pytest.raises(InputError, match="only one frame"):
        nees(reference.select([0]), estimate.select([0]), covariances[:1])
