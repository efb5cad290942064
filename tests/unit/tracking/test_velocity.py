"""Velocity of the camera: exact under constant acceleration, zero where it is not known, corrected by the rows."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.geometry import se3_exp
from splatbot.tracking.align import Alignment
from splatbot.tracking.velocity import CameraVelocity, twist_of_rows

DIRECTION = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])


def accelerating(t: float) -> np.ndarray:
    """Return the pose of a camera that turns about one axis at 1 + 3 t rad/s."""
    return se3_exp((t + 1.5 * t**2) * DIRECTION)


def test_a_constant_acceleration_is_followed_exactly() -> None:
    velocity = CameraVelocity()
    for t in (0.0, 0.03, 0.07):
        velocity.update(t, accelerating(t))
    np.testing.assert_allclose(velocity.at(0.1), 1.3 * DIRECTION, atol=1e-9)
    np.testing.assert_allclose(velocity.at(0.1, accelerating(0.1)), 1.3 * DIRECTION, atol=1e-9)


def test_the_velocity_is_unknown_at_the_start_after_a_gap_and_when_forgotten() -> None:
    velocity = CameraVelocity()
    assert not velocity.at(0.0).any()
    velocity.update(0.0, accelerating(0.0))
    assert not velocity.at(0.03).any()
    velocity.update(0.03, accelerating(0.03))
    assert velocity.at(0.06).any()
    assert (velocity.sigma(0.06) < velocity.sigma(1.0)).all()
    assert not velocity.at(1.0).any()
    velocity.forget()
    assert not velocity.at(0.06).any()


def test_a_correction_of_the_map_keeps_the_velocity() -> None:
    velocity, T = CameraVelocity(), se3_exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    for t in (0.0, 0.03):
        velocity.update(t, accelerating(t))
    before = velocity.at(0.06)
    velocity.move(T)
    np.testing.assert_allclose(velocity.at(0.06), before, atol=1e-12)


def aligned(bands_information: np.ndarray, bands_gradient: np.ndarray) -> Alignment:
    zero = np.zeros((6, 6))
    return Alignment(np.eye(4), zero, zero, zero, 48, 500.0, bands_information, bands_gradient)


def test_the_rows_tell_the_error_of_the_twist() -> None:
    """Linear residuals J (δ - s η) of 6 bands: the least-squares solution is the true η."""
    rng, readout = np.random.default_rng(0), 0.03
    used, true, pose = rng.normal(size=6), rng.normal(size=6), 1e-3 * rng.normal(size=6)
    s = ((np.arange(6) + 0.5) / 6 - 0.5) * readout
    J = 1e3 * rng.normal(size=(6, 40, 6))
    residual = -np.einsum("bij,bj->bi", J, pose - s[:, None] * (true - used))
    H, g = np.einsum("bki,bkj->bij", J, J), np.einsum("bki,bk->bi", J, residual)
    found = twist_of_rows(aligned(H, g), used, np.zeros(6), np.full(6, 1e4), readout)
    np.testing.assert_allclose(found, true, atol=1e-4)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_rows_without_information_leave_the_prior(value: float) -> None:
    prior = np.arange(6.0)
    found = twist_of_rows(aligned(np.full((6, 6, 6), value), np.zeros((6, 6))), np.ones(6), prior, np.ones(6), 0.03)
    np.testing.assert_allclose(found, prior, atol=1e-9)
    empty = twist_of_rows(Alignment.unconstrained(np.eye(4)), np.ones(6), prior, np.ones(6), 0.03)
    np.testing.assert_allclose(empty, prior, atol=1e-9)
