"""Trajectories: evaluation, exports."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest
from scipy.interpolate import BSpline

from splatbot.errors import InputError
from splatbot.planning import Certificate, JointTrajectory

NOTHING = Certificate(False, 1e-3, 0.0, 0.0, -1)


def trajectory(seed: int = 0, count: int = 20) -> JointTrajectory:
    control = np.cumsum(np.random.default_rng(seed).normal(0, 0.1, (count, 2)), axis=0)
    control[:3], control[-3:] = control[2], control[-3]
    return JointTrajectory(("a", "b"), control, 0.05, NOTHING)


def test_states_are_those_of_scipys_spline() -> None:
    own = trajectory()
    knots = (np.arange(len(own.control) + 4) - 3) * own.step
    spline = BSpline(knots, own.control, 3)
    t = np.linspace(0, own.duration, 333)
    states = own.at(t)
    for order, value in enumerate((states.position, states.velocity, states.acceleration)):
        np.testing.assert_allclose(value, spline.derivative(order)(t) if order else spline(t), atol=1e-9)
    inner = t[(t % own.step > 1e-6) & (t % own.step < own.step - 1e-6)]
    np.testing.assert_allclose(own.at(inner).jerk, spline.derivative(3)(inner), atol=1e-6)


def test_before_the_start_and_after_the_end_it_rests() -> None:
    own = trajectory()
    states = own.at([-1.0, own.duration + 1.0])
    np.testing.assert_allclose(states.position, [own.start, own.end])
    assert not states.velocity.any()
    assert not states.acceleration.any()


def test_slowed_down_it_is_the_same_curve() -> None:
    own = trajectory()
    slow = own.slowed(3.0)
    t = np.linspace(0, own.duration, 50)
    np.testing.assert_allclose(slow.at(3 * t).position, own.at(t).position, atol=1e-12)
    np.testing.assert_allclose(slow.at(3 * t).velocity * 3, own.at(t).velocity, atol=1e-12)
    with pytest.raises(InputError, match="factor"):
        own.slowed(0.0)


def test_as_a_ros_message_times_increase_and_the_last_point_is_the_end() -> None:
    own = trajectory()
    message = json.loads(own.to_json(rate=30.0))
    assert message["joint_names"] == ["a", "b"]
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    assert times[0] == 0
    assert (np.diff(times) > 0).all()
    assert times[-1] == pytest.approx(own.duration, abs=1e-8)
    np.testing.assert_allclose(message["points"][-1]["positions"], own.end)
    assert all(0 <= p["time_from_start"]["nanosec"] < 10**9 for p in message["points"])


def test_as_csv_it_has_a_line_a_millisecond() -> None:
    own = trajectory()
    lines = list(csv.reader(io.StringIO(own.to_csv())))
    assert lines[0] == [
        "time",
        "position.a",
        "position.b",
        "velocity.a",
        "velocity.b",
        "acceleration.a",
        "acceleration.b",
    ]
    assert len(lines) == 1 + round(own.duration * 1000) + 1
    np.testing.assert_allclose([float(x) for x in lines[-1][1:3]], own.end, atol=1e-8)


@pytest.mark.parametrize(
    ("control", "step"),
    [(np.zeros((3, 2)), 0.1), (np.zeros((5, 3)), 0.1), (np.full((5, 2), np.nan), 0.1), (np.zeros((5, 2)), 0.0)],
)
def test_what_is_no_trajectory_is_refused(control: np.ndarray, step: float) -> None:
    with pytest.raises(InputError):
        JointTrajectory(("a", "b"), control, step, NOTHING)
