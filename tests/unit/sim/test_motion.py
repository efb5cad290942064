"""Motions of the twin's arm: between samples, from files, from moves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import FormatError, InputError
from splatbot.planning.problem import Certificate
from splatbot.planning.trajectory import JointTrajectory
from splatbot.robots.panda import panda
from splatbot.sim.motion import (
    hold,
    load_motion,
    minimum_jerk,
    motion_from_samples,
    motion_from_trajectory,
    motion_of,
)
from splatbot.sim.scene import load_scene

T = np.linspace(0.0, 2.0, 41)
Q = np.sin(T)[:, None] * np.linspace(0.1, 0.7, 7)
V = np.cos(T)[:, None] * np.linspace(0.1, 0.7, 7)


def test_between_samples_a_motion_is_a_cubic_with_their_velocities() -> None:
    t = np.linspace(0.0, 2.0, 777)
    q, v, a, opening = motion_from_samples(T, Q, V).at(t)
    np.testing.assert_allclose(q, np.sin(t)[:, None] * np.linspace(0.1, 0.7, 7), atol=2e-8)  # h^4 / 384
    np.testing.assert_allclose(v, np.cos(t)[:, None] * np.linspace(0.1, 0.7, 7), atol=3e-4)
    assert a.shape == q.shape
    assert opening is None


def test_before_and_after_it_is_at_rest() -> None:
    q, v, a, _ = motion_from_samples(T, Q, V).at([-1.0, 5.0])
    np.testing.assert_array_equal(q, Q[[0, -1]])
    assert not v.any()
    assert not a.any()


@pytest.mark.parametrize(
    ("t", "q"),
    [([0.0, 0.0], np.zeros((2, 7))), ([1.0, 2.0], np.zeros((2, 7))), ([0.0, 1.0], np.full((2, 7), np.nan))],
)
def test_times_out_of_order_and_nan_are_refused(t: list[float], q: np.ndarray) -> None:
    with pytest.raises(InputError, match="motion"):
        motion_from_samples(t, q, np.zeros_like(q))


def test_minimum_jerk_is_at_rest_at_each_knot_and_its_derivatives_are_derivatives() -> None:
    times, knots = np.array([0.0, 1.0, 3.0]), np.array([[0.0], [1.0], [-1.0]])
    t = np.linspace(0.0, 3.0, 3001)
    q, v, a = (minimum_jerk(t, times, knots, order) for order in range(3))
    np.testing.assert_allclose(np.gradient(q[:, 0], t)[1:-1], v[1:-1, 0], atol=2e-5)
    np.testing.assert_allclose(np.gradient(v[:, 0], t)[1:-1], a[1:-1, 0], atol=5e-2)
    for moment, value in ((0, 0.0), (1000, 1.0), (3000, -1.0)):
        assert q[moment, 0] == pytest.approx(value)
        assert v[moment, 0] == a[moment, 0] == pytest.approx(0.0, abs=1e-9)


def test_moves_lead_the_tool_to_their_places() -> None:
    motion = motion_of(load_scene("empty"), panda())
    at = panda().tcp(motion.at([1.2, 2.6])[0])[:, :3, 3]
    np.testing.assert_allclose(at, [[0.45, 0.30, 0.40], [0.45, -0.30, 0.40]], atol=1e-5)


def test_ros_json_and_csv_are_read_in_the_robots_order(tmp_path: Path) -> None:
    names = panda().chain.names
    points = [
        {
            "positions": q[::-1].tolist(),
            "velocities": v[::-1].tolist(),
            "time_from_start": {"sec": int(t), "nanosec": round((t - int(t)) * 1e9)},
        }
        for t, q, v in zip(T, Q, V, strict=True)
    ]
    (tmp_path / "a.json").write_text(json.dumps({"joint_names": names[::-1], "points": points}))
    header = ["time", *(f"position.{n}" for n in names), *(f"velocity.{n}" for n in names)]
    rows = [",".join(map(repr, map(float, [t, *q, *v]))) for t, q, v in zip(T, Q, V, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join([",".join(header), *rows]))
    for name in ("a.json", "a.csv"):
        motion = load_motion(tmp_path / name, panda())
        np.testing.assert_allclose(motion.position, Q, atol=1e-12)
        np.testing.assert_allclose(motion.velocity, V, atol=1e-12)


@pytest.mark.parametrize("text", ['{"points": []}', "time,position.a\n0,1\n1,2", "nonsense", "{"])
def test_a_file_that_is_no_trajectory_of_the_robot_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bad"
    path.write_text(text)
    with pytest.raises(FormatError, match="bad: trajectory: is no trajectory of panda"):
        load_motion(path, panda())


def test_a_hold_needs_time() -> None:
    with pytest.raises(InputError, match="seconds"):
        hold(np.zeros(7), 0.0)


def test_a_planners_trajectory_is_the_same_motion_directly_as_json_and_as_csv(tmp_path: Path) -> None:
    ease = np.array([0.0, 0.0, 0.0, 0.1, 0.4, 0.7, 0.9, 1.0, 1.0, 1.0])[:, None]
    control = panda().home + ease * np.linspace(-0.4, 0.5, 7)
    certificate = Certificate(True, 1e-3, 0.05, 0.0, 1)
    trajectory = JointTrajectory(panda().chain.names, control, 0.2, certificate)
    (tmp_path / "a.json").write_text(trajectory.to_json(rate=500.0))
    (tmp_path / "a.csv").write_text(trajectory.to_csv())
    t = np.linspace(0.0, trajectory.duration, 333)
    for motion in (
        motion_from_trajectory(trajectory),
        load_motion(tmp_path / "a.json", panda()),
        load_motion(tmp_path / "a.csv", panda()),
    ):
        assert motion.duration == pytest.approx(trajectory.duration, abs=1e-6)
        np.testing.assert_allclose(motion.at(t)[0], trajectory.at(t).position, atol=1e-6)
        np.testing.assert_allclose(motion.at(t)[1], trajectory.at(t).velocity, atol=2e-4)
