"""NEES: 1 for errors that are as large as their covariances say."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.evaluation import nees
from splatbot.geometry import se3_exp
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


def test_covariances_that_cannot_be_are_refused() -> None:
    reference, estimate, covariances = trajectories(5, 3)
    with pytest.raises(InputError, match=r"have shape \(4, 6, 6\) for 5 poses"):
        nees(reference, estimate, covariances[1:])
    covariances[2, 0, 0] = -1
    with pytest.raises(InputError, match="not positive definite"):
        nees(reference, estimate, covariances)
    with pytest.raises(InputError, match="only one frame"):
        nees(reference.select([0]), estimate.select([0]), covariances[:1])
