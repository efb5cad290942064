"""Time parametrization: limits, the certificate of the curve, and degenerate paths."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot._native import fastest_speeds
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.planning import Certificate, JointTrajectory, Path, time_path
from splatbot.planning.blends import rounded
from splatbot.planning.timing import TimingConstants, min_clearance, without_duplicates
from splatbot.protocols import Array
from splatbot.robots.panda import panda

CHAIN = panda().chain


def path_of(waypoints: Array) -> Path:
    """Return a path without a certificate."""
    cost = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    return Path(waypoints, cost, Certificate(False, 1e-3, 0.0, 0.0, -1))


def free_paths(arm: RobotSpheres, field: GaussianCollisionField, count: int, seed: int) -> list[Path]:
    """Return chains of up to four certified edges."""
    rng = np.random.default_rng(seed)
    q = panda().random(3000, rng)
    q = q[~arm.check(field, q).in_collision]
    found: list[Path] = []
    while len(found) < count:
        waypoints = [q[rng.integers(len(q))]]
        for other in q[rng.integers(0, len(q), 60)]:
            step = rng.uniform(0.2, 0.5) * (other - waypoints[-1])
            if not arm.certify(field, waypoints[-1][None], (waypoints[-1] + step)[None]).in_collision[0]:
                waypoints.append(waypoints[-1] + step)
            if len(waypoints) == 5:
                break
        if len(waypoints) > 2:
            found.append(path_of(np.array(waypoints)))
    return found


def _within_limits(trajectory: JointTrajectory) -> None:
    states = trajectory.sampled(1000.0)
    assert (np.abs(states.velocity) <= CHAIN.velocity * (1 + 1e-9)).all()
    assert (np.abs(states.acceleration) <= CHAIN.acceleration * (1 + 1e-9)).all()
    assert (np.abs(states.jerk) <= CHAIN.jerk * (1 + 1e-9)).all()
    assert ((states.position >= CHAIN.lower - 1e-12) & (states.position <= CHAIN.upper + 1e-12)).all()
    assert max(trajectory.load(CHAIN)) <= 1 + 1e-8
    for order in (states.velocity, states.acceleration):
        np.testing.assert_allclose(order[[0, -1]], 0.0, atol=1e-9)


def test_every_sample_at_a_kilohertz_respects_all_limits_and_the_ends_are_the_paths(
    arm: RobotSpheres, field: GaussianCollisionField
) -> None:
    for path in free_paths(arm, field, 12, 0):
        trajectory = time_path(path, arm, field)
        _within_limits(trajectory)
        np.testing.assert_allclose(trajectory.start, path.waypoints[0], atol=1e-12)
        np.testing.assert_allclose(trajectory.end, path.waypoints[-1], atol=1e-12)
        lower = (np.abs(np.diff(path.waypoints, axis=0)) / CHAIN.velocity).max(axis=1).sum()
        assert trajectory.duration < 2.0 * lower + 0.4  # it does not crawl


def test_what_is_certified_is_the_timed_curve_and_its_clearance_is_kept(
    arm: RobotSpheres, field: GaussianCollisionField
) -> None:
    for path in free_paths(arm, field, 10, 1):
        trajectory = time_path(path, arm, field)
        assert trajectory.certificate.certified
        q = trajectory.sampled(4000.0).position
        assert not arm.check(field, q).in_collision.any()
        seen = min(0.05, float(arm.clearance(field, q, cut=0.05).distance.min()))
        assert trajectory.certificate.clearance <= seen + 1e-9
        assert trajectory.certificate.clearance >= 0.97 * seen - 1e-3
        assert trajectory.certificate.map_version == field.map_version


def test_a_straight_line_takes_the_time_of_the_closed_form() -> None:
    start = np.zeros(7)
    end = start + np.array([1.5, 0, 0, 0, 0, 0, 0])
    start[3] = end[3] = -1.5
    trajectory = time_path(path_of(np.stack([start, end])), RobotSpheres(panda()), None)
    exact = 1.5 / CHAIN.velocity[0] + CHAIN.velocity[0] / CHAIN.acceleration[0]
    assert exact - 1e-9 <= trajectory.duration <= 1.03 * exact + 0.03
    short = start + 0.02 * (end - start)
    hop = time_path(path_of(np.stack([start, short])), RobotSpheres(panda()), None)
    assert hop.duration == pytest.approx(2 * np.sqrt(0.03 / CHAIN.acceleration[0]), rel=0.1, abs=0.02)


def test_speeds_on_a_circle_are_those_of_its_centripetal_acceleration() -> None:
    r, s = 0.3, np.linspace(0, 6.0, 4000)
    first = np.stack([-np.sin(s / r), np.cos(s / r)], axis=1)
    second = -np.stack([np.cos(s / r), np.sin(s / r)], axis=1) / r
    squared = fastest_speeds(s, first, second, np.full(2, 100.0), np.full(2, 6.0))
    # Where a joint turns back it carries all of the centripetal acceleration: v²/r <= 6.
    turning = np.abs(second).max(axis=1) * r > 1 - 1e-6
    assert squared[turning].max() <= 6.0 * r * 1.01
    assert squared[turning].max() >= 6.0 * r * 0.98
    assert squared.max() <= np.sqrt(2) * 6.0 * r
    assert squared[0] == squared[-1] == 0.0


@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-7, 1e-5, 9e-5, 2e-4])
def test_waypoints_that_are_nearly_the_same_change_nothing(arm: RobotSpheres, gap: float) -> None:
    rng = np.random.default_rng(2)
    corners = np.array([panda().home, panda().home + 0.3, panda().home + np.array([0.5, 0.1, 0.4, 0.2, 0.3, 0.3, 0])])
    plain = time_path(path_of(corners), arm, None)
    noisy = np.concatenate(
        [
            corners[:1],
            corners[:1] + gap,
            corners[1:2],
            corners[1:2] + gap * rng.random((3, 7)),
            corners[2:] - gap,
            corners[2:],
        ]
    )
    trajectory = time_path(path_of(noisy), arm, None)
    _within_limits(trajectory)
    np.testing.assert_allclose(trajectory.end, corners[2], atol=1e-12)
    assert trajectory.duration == pytest.approx(plain.duration, rel=0.1, abs=0.15)


def test_from_a_place_to_itself_there_is_rest() -> None:
    arm = RobotSpheres(panda())
    trajectory = time_path(path_of(np.stack([panda().home, panda().home])), arm, None)
    states = trajectory.sampled()
    assert trajectory.certificate.certified
    assert trajectory.duration > 0
    np.testing.assert_allclose(states.position, np.broadcast_to(panda().home, states.position.shape), atol=1e-12)
    np.testing.assert_allclose(states.velocity, 0.0, atol=1e-9)


def test_a_way_there_and_back_and_a_hundred_waypoints_are_timed(arm: RobotSpheres) -> None:
    a, b = panda().home, panda().home + 0.4
    _within_limits(time_path(path_of(np.stack([a, b, a, b])), arm, None))
    rng = np.random.default_rng(3)
    many = panda().home + np.cumsum(rng.normal(0, 0.03, (100, 7)), axis=0)
    many = np.clip(many, CHAIN.lower + 0.01, CHAIN.upper - 0.01)
    _within_limits(time_path(path_of(many), arm, None))


def test_where_no_rounding_is_free_the_arm_stops_at_the_corner(
    arm: RobotSpheres, field: GaussianCollisionField, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = free_paths(arm, field, 1, 4)[0]
    rounded_time = time_path(path, arm, field).duration
    monkeypatch.setattr("splatbot.planning.timing.CONSTANTS", TimingConstants(min_reach=1e3))  # no blend is long enough
    trajectory = time_path(path, arm, field)
    assert trajectory.certificate.certified
    assert trajectory.duration > rounded_time
    _within_limits(trajectory)
    # Every place of it is on the path.
    q = trajectory.sampled(500.0).position
    a, b = path.waypoints[:-1], path.waypoints[1:]
    share = np.clip(np.einsum("nej,ej->ne", q[:, None] - a, b - a) / ((b - a) ** 2).sum(axis=1), 0, 1)
    off = np.linalg.norm(q[:, None] - a - share[..., None] * (b - a), axis=-1).min(axis=1)
    assert off.max() < 1e-7


def test_a_path_that_is_not_free_is_timed_and_said_not_to_be(arm: RobotSpheres, field: GaussianCollisionField) -> None:
    q = panda().random(2000, np.random.default_rng(5))
    free = q[~arm.check(field, q).in_collision]
    hit = arm.certify(field, free[:-1:2], free[1::2]).in_collision
    a, b = free[:-1:2][hit][0], free[1::2][hit][0]
    trajectory = time_path(path_of(np.stack([a, b])), arm, field)
    assert not trajectory.certificate.certified
    assert trajectory.certificate.clearance == 0.0
    _within_limits(trajectory)


@pytest.mark.long
def test_no_sphere_is_farther_from_the_chords_than_stated(arm: RobotSpheres, field: GaussianCollisionField) -> None:
    for path in free_paths(arm, field, 2, 6):
        trajectory = time_path(path, arm, field)
        chords = trajectory.pieces().chords(arm.reach)
        start, end, first, last = chords.start, chords.end, chords.first, chords.last
        assert first[0] == 0
        assert last[-1] == len(trajectory.control) - 4
        np.testing.assert_allclose(start[1:], end[:-1], atol=1e-12)
        t = np.linspace(0, trajectory.duration, 40)
        at = arm.centers(trajectory.at(t).position)
        share = np.linspace(0, 1, 200)[:, None, None]
        dense = arm.centers((start + share * (end - start)).reshape(-1, 7))
        for i in range(40):
            gap = np.linalg.norm(dense - at[i], axis=-1).max(axis=1).min()
            assert gap < 1e-4 + 4e-3  # the dense places are up to 8 mm apart
    assert len(start) < len(trajectory.control)


def test_the_least_room_is_never_above_what_dense_samples_see(arm: RobotSpheres, field: GaussianCollisionField) -> None:
    rng = np.random.default_rng(7)
    for _ in range(5):
        control = panda().home + np.cumsum(rng.normal(0, 0.02, (60, 7)), axis=0)
        dense = JointTrajectory(CHAIN.names, control, 1.0, Certificate(False, 0, 0, 0, -1)).at(np.linspace(0, 57, 4000))
        seen = min(0.05, float(arm.clearance(field, dense.position, cut=0.05).distance.min()))
        clearance = min_clearance(arm, field, control)
        assert clearance <= seen + 1e-9
        assert clearance >= 0.97 * seen - 2e-3


def test_blends_join_with_equal_first_and_second_derivatives() -> None:
    rng = np.random.default_rng(8)
    waypoints = rng.normal(size=(5, 7))
    curve = rounded(waypoints, np.array([0, 0.3, 0.5, 0.2, 0]), 0)
    joints = np.cumsum(curve.length)[:-1]
    for s in joints:
        before, after = curve.at(np.array([s - 1e-9])), curve.at(np.array([s + 1e-9]))
        for x, y in zip(before, after, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-5)
    s = np.linspace(0, curve.total, 2000)
    q, first, _ = curve.at(s)
    np.testing.assert_allclose(np.gradient(q, s, axis=0)[2:-2], first[2:-2], atol=2e-2)


def test_duplicates_are_dropped_and_the_ends_kept() -> None:
    waypoints = np.array([[0.0], [1e-6], [1.0], [1.0 + 1e-6]])
    np.testing.assert_array_equal(without_duplicates(waypoints), [[0.0], [1.0 + 1e-6]])
    assert len(without_duplicates(np.zeros((4, 2)))) == 1


@pytest.mark.parametrize("scales", [(0.0, 1.0), (1.0, 1.5), (np.nan, 1.0)])
def test_scales_out_of_range_are_named(scales: tuple[float, float]) -> None:
    path = path_of(np.stack([panda().home, panda().home + 0.1]))
    with pytest.raises(InputError, match="_scale"):
        time_path(path, RobotSpheres(panda()), None, velocity_scale=scales[0], acceleration_scale=scales[1])


def test_half_the_velocity_takes_longer_and_stays_within_half() -> None:
    path = path_of(np.stack([panda().home, panda().home + 0.4]))
    arm = RobotSpheres(panda())
    whole, half = time_path(path, arm, None), time_path(path, arm, None, velocity_scale=0.5, acceleration_scale=0.5)
    assert half.duration > whole.duration
    assert half.load(CHAIN)[0] <= 0.5 + 1e-9
    assert half.load(CHAIN)[1] <= 0.5 + 1e-9
