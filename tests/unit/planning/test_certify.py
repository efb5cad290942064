"""Certification of motions as they are executed, against dense float64 samples."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.planning import MotionRefusedError, WaypointMotion, certify_motion, time_path
from splatbot.planning.cubics import CubicPieces
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from tests.unit.planning.test_timing import path_of

HOME = np.asarray(panda().home)
TURN = np.eye(7)[0]


def ball(at: Array, radius: float = 0.05) -> GaussianCollisionField:
    scales = [[radius / 3.0] * 3]
    return GaussianCollisionField(
        GaussianModel.from_activated(
            means=[at], quats=[[1.0, 0, 0, 0]], scales=scales, opacities=[0.9], colors=[[1.0, 0, 0]]
        )
    )


def turn(seconds: float, angle: float = 0.3) -> WaypointMotion:
    return WaypointMotion([0.0, seconds], [HOME, HOME + angle * TURN])


def test_the_largest_shares_of_the_limits_are_those_of_dense_samples() -> None:
    rng = np.random.default_rng(1)
    chain = panda().chain
    for _ in range(20):
        times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.05, 1.0, 6))])
        pieces = WaypointMotion(times, rng.normal(size=(7, 7))).pieces()
        load = pieces.load(chain)
        share = np.linspace(0.0, 1.0, 400)
        largest = np.zeros(3)
        for k in range(len(pieces)):
            h = pieces.time[k + 1] - pieces.time[k]
            at = pieces._at(share[:, None], np.full(400, k))
            v = np.diff(at, axis=0) / (h / 399)
            a = np.diff(v, axis=0) / (h / 399)
            j = np.diff(a, axis=0) / (h / 399)
            found = [(np.abs(v) / chain.velocity).max(), (np.abs(a) / chain.acceleration).max()]
            largest = np.maximum(largest, [*found, (np.abs(j) / chain.jerk).max()])
        np.testing.assert_allclose([load.velocity, load.acceleration, load.jerk], largest, rtol=0.02)
        assert load.velocity >= largest[0] - 1e-9


def test_the_extent_is_never_exceeded_and_is_reached() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        curve = WaypointMotion(np.arange(6.0), rng.normal(size=(6, 7)))
        dense = np.array([curve.reference(float(t))[0] for t in np.linspace(0.0, 5.0, 4001)])
        low, high = curve.pieces().extent()
        assert (low <= dense.min(axis=0) + 1e-9).all()
        assert (high >= dense.max(axis=0) - 1e-9).all()
        np.testing.assert_allclose(low, dense.min(axis=0), atol=1e-4)
        np.testing.assert_allclose(high, dense.max(axis=0), atol=1e-4)


@pytest.mark.long
def test_no_sphere_deviates_from_the_chords_by_more_than_stated() -> None:
    rng = np.random.default_rng(3)
    arm = RobotSpheres(panda())
    q = HOME + np.cumsum(rng.normal(0.0, 0.1, (6, 7)), axis=0)
    curve = WaypointMotion(np.arange(6.0), q)
    chords = curve.pieces().chords(arm.reach)
    np.testing.assert_allclose(chords.start[1:], chords.end[:-1], atol=1e-12)
    t = np.linspace(0.0, 5.0, 60)
    at = arm.centers(np.array([curve.reference(float(x))[0] for x in t]))
    share = np.linspace(0, 1, 60)[:, None, None]
    dense = arm.centers((chords.start + share * (chords.end - chords.start)).reshape(-1, 7))
    for centers in at:
        gap = np.linalg.norm(dense - centers, axis=-1).max(axis=1).min()
        assert gap < 1e-4 + 2e-3  # the dense places are up to 4 mm apart


def test_a_free_motion_within_the_limits_is_certified() -> None:
    arm = RobotSpheres(panda())
    motion = certify_motion(turn(2.0), arm, ball(np.array([3.0, 0.0, 0.0])))
    assert motion.duration == 2.0
    np.testing.assert_allclose(motion.reference(2.0)[0], HOME + 0.3 * TURN)


@pytest.mark.parametrize(
    ("motion", "why"),
    [
        (turn(1e-9, 2.0), "velocity limit of panda_joint1"),
        (turn(0.15), "times the velocity limit|times the acceleration limit"),
        (turn(3.0, 2.95), "beyond its limit"),
        (WaypointMotion([0.0, 1.0], np.zeros((2, 6))), "has 6 joints"),
    ],
)
def test_a_motion_beyond_a_limit_is_refused_by_joint(motion: WaypointMotion, why: str) -> None:
    with pytest.raises(MotionRefusedError, match=why):
        certify_motion(motion, RobotSpheres(panda()), None)


def test_the_stated_slowdown_is_enough() -> None:
    load = turn(0.2, 0.5).pieces().load(panda().chain)
    assert load.slowdown > 1.0
    certify_motion(turn(0.2 * load.slowdown * (1 + 1e-9), 0.5), RobotSpheres(panda()), None)


def test_a_curve_that_leaves_its_chords_into_an_obstacle_is_refused_although_its_waypoints_are_free() -> None:
    """The cubic between free waypoints swings out by 0.05 rad and more; the obstacle is there."""
    arm = RobotSpheres(panda())
    q = np.stack([HOME, HOME + 0.5 * TURN, HOME + 0.5 * TURN, HOME])
    curve = WaypointMotion([0.0, 0.8, 1.6, 2.4], q)
    dense = np.array([curve.reference(t)[0] for t in np.linspace(0.0, 2.4, 1000)])
    out = dense[np.argmax(dense[:, 0])]
    assert out[0] > HOME[0] + 0.55
    side = panda().tcp(out)[:3, 3] - panda().tcp(HOME + 0.5 * TURN)[:3, 3]
    hand = arm.centers(out[None])[0]
    tip = hand[np.argmax(hand @ side)]
    outward = side / np.linalg.norm(side)
    places = (ball(tip + distance * outward, 0.03) for distance in np.arange(0.3, 0.0, -0.005))
    field = next(field for field in places if arm.check(field, out[None]).in_collision[0])
    assert not arm.certify(field, q[:-1].copy(), q[1:].copy()).in_collision.any()
    with pytest.raises(MotionRefusedError, match="not certified as free"):
        certify_motion(curve, arm, field)


def test_a_motion_that_does_not_rest_at_its_ends_is_refused() -> None:
    line = np.array([-1])

    class Going:
        duration = 1.0

        def reference(self, t: float) -> tuple[Array, Array]:
            return HOME + 0.1 * t * TURN, 0.1 * TURN

        def pieces(self) -> CubicPieces:
            ends = np.stack([HOME, HOME + 0.1 * TURN])
            return CubicPieces(np.array([0.0, 1.0]), ends, np.zeros((2, 7)), line)

    with pytest.raises(MotionRefusedError, match="at rest"):
        certify_motion(Going(), RobotSpheres(panda()), None)


def test_the_rest_of_a_motion_is_certified_again_in_a_later_map_and_what_is_past_is_not() -> None:
    arm = RobotSpheres(panda())
    motion = certify_motion(turn(2.0, 1.0), arm, ball(np.array([3.0, 0.0, 0.0])))
    at_start = ball(panda().tcp(HOME)[:3, 3])
    with pytest.raises(MotionRefusedError):
        motion.recertified(at_start, time=0.0)
    motion.recertified(at_start, time=1.5)
    with pytest.raises(MotionRefusedError):
        motion.recertified(ball(panda().tcp(HOME + TURN)[:3, 3]), time=1.5)


def test_trajectories_of_the_planner_are_certified_as_they_are() -> None:
    rng = np.random.default_rng(8)
    arm, certified = RobotSpheres(panda()), 0
    for _ in range(10):
        waypoints = np.stack([HOME, *(HOME + rng.normal(0.0, 0.3, (3, 7)))])
        waypoints = np.clip(waypoints, panda().chain.lower + 0.01, panda().chain.upper - 0.01)
        trajectory = time_path(path_of(waypoints), arm, None)
        if trajectory.certificate.certified:
            certify_motion(trajectory, arm, None)
            certified += 1
    assert certified >= 5
