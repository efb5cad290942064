"""Planned paths in a twin of the true shapes: certified ones must not collide, pushed ones must cause contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.planning_problems import problems
from splatbot.bench.tabletop import Ball, Block, Can, Solid, Tabletop, tabletop
from splatbot.bench.truth import Truth
from splatbot.collision import GaussianCollisionField
from splatbot.planning import GaussianRRTStar
from splatbot.protocols import Array, KinematicChain
from splatbot.robots.panda import panda
from splatbot.robots.robot import RobotModel
from splatbot.robots.shapes import Capsule
from splatbot.sim.motion import MINIMUM_JERK_PEAK, JointMotion, minimum_jerk
from splatbot.sim.scene import Scene, make_scene
from splatbot.sim.twin import Twin


@dataclass(frozen=True)
class TwinPathConstants:
    """Constants of paths that a twin executes."""

    margin: float = 0.005
    """Margin [m] of the plans. It covers the millimetre by which the arm leaves its path; a larger one leaves more
    problems unsolved."""
    push_depth: float = 0.01
    """Depth [m] of a pushed path in an obstacle. A larger one leaves fewer places from which it can be reached."""
    axis_points: int = 13
    """Number of points [1] on a capsule's axis. More of them find the clearance of long links more exactly, in
    proportional time."""
    spare: int = 20
    """Number of additional problems [1], because some have no path within the budget."""
    departures: int = 12
    """Number of configurations [1] at which a pushed path may leave the path. More of them push more paths, and take
    longer."""
    first_link: int = 3
    """Index [1] of the first link whose clearance is checked. Paths hardly change that of earlier links."""
    limit_share: float = 0.6
    """Share [1] of the joints' limits of velocity and acceleration. A larger one leaves the controller less reserve."""


CONSTANTS = TwinPathConstants()


@dataclass(frozen=True)
class PathTrials:
    """Results of planned and pushed paths.

    Args:
        planned: Number of paths that were found.
        problems: Number of problems.
        certified: Number of certified paths.
        in_contact: Number of planned paths on which the arm had a contact.
        least_clearance: Least clearance over all paths [m].
        pushed: Number of paths that could be pushed into an obstacle.
        detected: Number of pushed paths on which the twin detected a contact.
        real_time: Ratio of simulated to real time.
    """

    planned: int
    problems: int
    certified: int
    in_contact: int
    least_clearance: float
    pushed: int
    detected: int
    real_time: float


def truth_scene(table: Tabletop) -> Scene:
    """Build the scene of the true shapes, without a map."""
    objects = [
        {"name": f"thing{i}", "shapes": [_shape(solid)], **_place(solid)} for i, solid in enumerate(table.solids)
    ]
    return make_scene({"name": "truth", "objects": objects})


def try_paths(
    count: int, *, gaussians: int, budget_ms: float, report_progress: ReportProgress = ignore_progress, seed: int = 0
) -> PathTrials:
    """Plan ``count`` problems in a map of the table top, and follow the paths among the true shapes."""
    table, robot = tabletop(), panda()
    field = GaussianCollisionField(table.gaussians(gaussians))
    planner = GaussianRRTStar(field, robot, margin=CONSTANTS.margin)
    truth = Truth(table)
    twin = Twin(truth_scene(table))
    planned = certified = in_contact = pushed = detected = 0
    least, simulated, spent = np.inf, 0.0, 0.0
    tried = 0
    for i, problem in enumerate(problems(robot, planner.arm, field, truth, count + CONSTANTS.spare, seed)):
        if planned == count:
            break
        if planned % 20 == 0:
            report_progress(f"path {planned} of {count}")
        tried += 1
        path = planner.plan(problem.start, problem.goal, budget_ms=budget_ms, seed=seed + i).path
        if path is None:
            continue
        planned += 1
        certified += path.certificate.certified
        result = twin.follow(timed(path.waypoints, robot.chain))
        in_contact += bool(result.contacts)
        least = min(least, result.clearance.value)
        simulated, spent = simulated + result.duration, spent + result.seconds
        into = push(path.waypoints, robot, table, CONSTANTS.push_depth)
        if into is not None:
            pushed += 1
            detected += bool(twin.follow(timed(into, robot.chain), until_contact=True).contacts)
    return PathTrials(
        planned, tried, certified, in_contact, float(least), pushed, detected, simulated / max(spent, 1e-9)
    )


def timed(waypoints: Array, chain: KinematicChain) -> JointMotion:
    """Time a motion along the edges, at rest at each waypoint, within the limits of velocity and acceleration."""
    steps = np.abs(np.diff(waypoints, axis=0))
    # The acceleration of minimum jerk peaks at 5.774 of distance over time squared.
    slow = (MINIMUM_JERK_PEAK * steps / (CONSTANTS.limit_share * chain.velocity)).max(axis=1)
    soft = np.sqrt((5.774 * steps / (CONSTANTS.limit_share * chain.acceleration)).max(axis=1))
    times = np.concatenate([[0.0], np.cumsum(np.maximum(np.maximum(slow, soft), 0.02))])
    t = np.unique(np.concatenate([np.arange(0.0, times[-1], 4e-3), times]))
    q, v, a = (minimum_jerk(t, times, waypoints, order) for order in range(3))
    return JointMotion(t, q, v, a)


def arm_clearance(robot: RobotModel, table: Tabletop, q: Array, first: int = 1) -> Array:
    """Compute the signed distance (C,) [m] between the shapes and the capsules of links from ``first``, gripper open.

    The closed form samples 13 points of each axis and is at most a few millimetres too large.
    """
    T = robot.fk(q)
    found = []
    for link, shape in _capsules(robot):
        if link < first:
            continue
        at = np.linspace(shape.start, shape.end, CONSTANTS.axis_points)
        world = np.einsum("cij,pj->cpi", T[:, link, :3, :3], at) + T[:, link, None, :3, 3]
        found.append(table.distance(world.reshape(-1, 3)).reshape(len(q), -1).min(axis=1) - shape.radius)
    return np.asarray(np.min(found, axis=0))


def push(waypoints: Array, robot: RobotModel, table: Tabletop, depth: float) -> Array | None:
    """Follow the path to its least clearance, then descend the clearance to a penetration of ``depth`` [m].

    If joint limits or a local minimum stop the descent, it starts from other configurations of the path, then along
    random directions. If None, no start leads to the penetration.
    """
    share = np.linspace(0.0, len(waypoints) - 1, 20 * len(waypoints))
    edge = np.minimum(share.astype(int), len(waypoints) - 2)
    q = waypoints[edge] + (share - edge)[:, None] * (waypoints[edge + 1] - waypoints[edge])
    nearest = np.argsort(arm_clearance(robot, table, q, CONSTANTS.first_link), kind="stable")
    for k in nearest[:: max(1, len(nearest) // CONSTANTS.departures)]:
        out = _deeper(q[k], robot, table, depth)
        if out is not None:
            return np.concatenate([waypoints[: edge[k] + 1], out])
    k = int(nearest[0])
    out = _straight_in(q[k], robot, table, depth)
    return None if out is None else np.concatenate([waypoints[: edge[k] + 1], out])


def _straight_in(start: Array, robot: RobotModel, table: Tabletop, depth: float) -> Array | None:
    """Follow the first of a hundred random joint directions with a penetration of ``depth`` [m]."""
    rng = np.random.default_rng(0)
    far = np.linspace(0.0, 1.0, 251)[:, None]
    for _ in range(100):
        direction = rng.standard_normal(len(start))
        q = start + far * direction / np.linalg.norm(direction)
        q = q[((q >= robot.chain.lower) & (q <= robot.chain.upper)).all(axis=1)]
        deep = np.flatnonzero(arm_clearance(robot, table, q, CONSTANTS.first_link) <= -depth)
        if len(deep):
            return np.stack([q[0], q[deep[0]]])
    return None


def _deeper(start: Array, robot: RobotModel, table: Tabletop, depth: float) -> Array | None:
    at = start.copy()
    out = [at.copy()]
    for _ in range(400):
        clearance = float(arm_clearance(robot, table, at[None], CONSTANTS.first_link)[0])
        if clearance <= -depth:
            return np.array(out)
        probes = at + 1e-5 * np.eye(len(at))
        slope = (arm_clearance(robot, table, probes, CONSTANTS.first_link) - clearance) / 1e-5
        length = float(np.linalg.norm(slope))
        if length < 1e-3:
            return None
        step = at - min(0.02, max(clearance + 1.2 * depth, 1e-3) / length) * slope / length
        at = np.clip(step, robot.chain.lower + 0.01, robot.chain.upper - 0.01)
        out.append(at.copy())
    return None


def _capsules(robot: RobotModel) -> list[tuple[int, Capsule]]:
    """Return the capsules of the moving links, and of the fingers in the frame of the last link."""
    found = [(s.link, s) for s in robot.shapes if isinstance(s, Capsule) and s.link > 0]
    if robot.gripper is not None:
        opened = np.array([0.0, robot.gripper.stroke, 0.0])
        for T in robot.gripper.T_link_finger:
            for s in robot.gripper.shapes:
                if isinstance(s, Capsule):
                    ends = np.array([s.start, s.end]) + opened
                    a, b = ends @ T[:3, :3].T + T[:3, 3]
                    found.append((len(robot), Capsule(len(robot), tuple(a), tuple(b), s.radius)))
    return found


def _shape(solid: Solid) -> dict[str, object]:
    if isinstance(solid, Block):
        return {"kind": "box", "size": solid.size}
    if isinstance(solid, Can):
        return {"kind": "cylinder", "radius": solid.radius, "height": solid.height}
    assert isinstance(solid, Ball)
    return {"kind": "sphere", "radius": solid.radius}


def _place(solid: Solid) -> dict[str, object]:
    if isinstance(solid, Can):
        x, y, z = solid.foot
        return {"at": (x, y, z + solid.height / 2)}
    assert isinstance(solid, Block | Ball)
    return {"at": solid.center, "rpy": (0.0, 0.0, solid.yaw if isinstance(solid, Block) else 0.0)}
