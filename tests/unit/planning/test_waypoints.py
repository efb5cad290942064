"""Splines through positions at times."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.planning import JointTrajectory, WaypointMotion
from splatbot.planning.problem import Certificate


def _random(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 0.5, count - 1))])
    return times, rng.normal(size=(count, 3))


@pytest.mark.parametrize("count", [2, 3, 4, 9])
def test_the_spline_meets_its_waypoints_with_continuous_acceleration_and_rests_at_both_ends(count: int) -> None:
    times, q = _random(np.random.default_rng(count), count)
    curve = WaypointMotion(times, q)
    for t, position in zip(times, q, strict=True):
        np.testing.assert_allclose(curve.reference(float(t))[0], position, atol=1e-12)
    pieces = curve.pieces()
    v0, v1 = pieces.velocities()
    np.testing.assert_allclose(v1[:-1], v0[1:], atol=1e-9)
    np.testing.assert_allclose([v0[0], v1[-1]], 0.0, atol=1e-9)
    second = curve._velocity.derivative()
    np.testing.assert_allclose([second(0.0), second(times[-1])], 0.0, atol=1e-8)
    for t in (-1.0, 0.0, times[-1], 100.0):
        assert not curve.reference(float(t))[1].any()


def test_the_pieces_are_the_curve_that_is_executed() -> None:
    times, q = _random(np.random.default_rng(3), 7)
    curve = WaypointMotion(times, q)
    pieces = curve.pieces()
    for k in range(len(pieces)):
        for share in np.linspace(0.0, 1.0, 7):
            t = (1.0 - share) * pieces.time[k] + share * pieces.time[k + 1]
            at = pieces._at(np.array([[share]]), np.array([k]))[0]
            np.testing.assert_allclose(at, curve.reference(float(t))[0], atol=1e-10)


def test_samples_of_a_trajectory_at_its_knots_give_the_same_curve_again() -> None:
    rng = np.random.default_rng(5)
    inner = np.cumsum(rng.normal(0.0, 0.01, (30, 7)), axis=0)
    control = np.concatenate([np.repeat(inner[:1], 2, axis=0), inner, np.repeat(inner[-1:], 2, axis=0)])
    trajectory = JointTrajectory(tuple("abcdefg"), control, 0.004, Certificate(False, 0.0, 0.0, 0.0, -1))
    points = trajectory.to_ros()["points"]
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points]
    again = WaypointMotion(times, [p["positions"] for p in points])
    for t in np.linspace(0.0, trajectory.duration, 500):
        np.testing.assert_allclose(again.reference(float(t))[0], trajectory.at(t).position, atol=1e-9)


@pytest.mark.parametrize(
    ("times", "q"),
    [
        ([0.0], [[1.0]]),
        ([0.0, 0.0], [[1.0], [2.0]]),
        ([1.0, 2.0], [[1.0], [2.0]]),
        ([0.0, np.nan], [[1.0], [2.0]]),
        ([0.0, 1.0], [[1.0], [np.inf]]),
        ([0.0, 1.0], [1.0, 2.0]),
        ([0.0, 1.0, 2.0], [[1.0], [2.0]]),
    ],
)
def test_times_that_do_not_increase_from_0_and_values_that_are_not_finite_are_errors(
    times: list[float], q: list[list[float]]
) -> None:
    with pytest.raises(InputError):
        WaypointMotion(times, q)
