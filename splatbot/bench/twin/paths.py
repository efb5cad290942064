"""Planned paths tried in a twin of the true shapes: certified ones must touch nothing, pushed ones must be seen."""

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
from splatbot.sim.motion import JointMotion, minimum_jerk
from splatbot.sim.scene import Scene, make_scene
from splatbot.sim.twin import Twin

MARGIN = 0.005  # [m] that plans keep: the arm follows to a millimetre
DEPTH = 0.01  # [m] that pushed paths go into an obstacle
_ALONG = 13  # points on a capsule's axis
_SPARE = 20  # problems more than paths are wanted: for some no path is found in time
_LEAVES = 12  # places at which a path may be left
_MOBILE = 3  # links before it turn in their place, as near to the table as ever
_SHARE = 0.6  # of the joints' limits of velocity and acceleration


@dataclass(frozen=True)
class PathTrials:
    """What came of them.

    Args:
        planned: paths that were found, of ``asked``.
        asked: problems.
        certified: of those planned.
        touched: certified paths on which the arm touched anything.
        least_room: over all certified paths [m].
        pushed: paths that could be pushed into an obstacle.
        seen: of them, those on which the twin saw contact.
        real_time: simulated over real time.
    """

    planned: int
    asked: int
    certified: int
    touched: int
    least_room: float
    pushed: int
    seen: int
    real_time: float


def truth_scene(table: Tabletop) -> Scene:
    """The shapes themselves as a scene: nothing of it comes from a map."""
    things = [{"name": f"thing{i}", "shapes": [_shape(solid)], **_place(solid)} for i, solid in enumerate(table.solids)]
    return make_scene({"name": "truth", "objects": things})


def try_paths(
    count: int, *, gaussians: int, budget_ms: float, report_progress: ReportProgress = ignore_progress, seed: int = 0
) -> PathTrials:
    """Plan ``count`` problems in a map of the table top, and follow the paths among the true shapes."""
    table, robot = tabletop(), panda()
    field = GaussianCollisionField(table.gaussians(gaussians))
    planner = GaussianRRTStar(field, robot, margin=MARGIN)
    truth = Truth(table)
    twin = Twin(truth_scene(table))
    planned = certified = touched = pushed = seen = 0
    least, simulated, spent = np.inf, 0.0, 0.0
    asked = 0
    for i, problem in enumerate(problems(robot, planner.arm, field, truth, count + _SPARE, seed)):
        if planned == count:
            break
        if planned % 20 == 0:
            report_progress(f"path {planned} of {count}")
        asked += 1
        path = planner.plan(problem.start, problem.goal, budget_ms=budget_ms, seed=seed + i).path
        if path is None:
            continue
        planned += 1
        certified += path.certificate.certified
        result = twin.follow(timed(path.waypoints, robot.chain))
        touched += bool(result.contacts)
        least = min(least, result.clearance.value)
        simulated, spent = simulated + result.duration, spent + result.seconds
        into = push(path.waypoints, robot, table, DEPTH)
        if into is not None:
            pushed += 1
            seen += bool(twin.follow(timed(into, robot.chain), until_contact=True).contacts)
    return PathTrials(planned, asked, certified, touched, float(least), pushed, seen, simulated / max(spent, 1e-9))


def timed(waypoints: Array, chain: KinematicChain) -> JointMotion:
    """A motion exactly along the edges, at rest at each waypoint, within the limits of velocity and acceleration."""
    steps = np.abs(np.diff(waypoints, axis=0))
    # Minimum jerk peaks at 1.875 of the mean velocity and at 5.774 of distance over time squared.
    slow = (1.875 * steps / (_SHARE * chain.velocity)).max(axis=1)
    soft = np.sqrt((5.774 * steps / (_SHARE * chain.acceleration)).max(axis=1))
    times = np.concatenate([[0.0], np.cumsum(np.maximum(np.maximum(slow, soft), 0.02))])
    t = np.unique(np.concatenate([np.arange(0.0, times[-1], 4e-3), times]))
    q, v, a = (minimum_jerk(t, times, waypoints, order) for order in range(3))
    return JointMotion(t, q, v, a)


def arm_room(robot: RobotModel, table: Tabletop, q: Array, first: int = 1) -> Array:
    """Distance (C,) [m] between the capsules of links from ``first`` on, gripper open, and the shapes; signed.

    In closed form, at 13 points of each axis: at most a few millimetres above the exact one.
    """
    T = robot.fk(q)
    found = []
    for link, shape in _capsules(robot):
        if link < first:
            continue
        at = np.linspace(shape.start, shape.end, _ALONG)
        world = np.einsum("cij,pj->cpi", T[:, link, :3, :3], at) + T[:, link, None, :3, 3]
        found.append(table.distance(world.reshape(-1, 3)).reshape(len(q), -1).min(axis=1) - shape.radius)
    return np.asarray(np.min(found, axis=0))


def push(waypoints: Array, robot: RobotModel, table: Tabletop, depth: float) -> Array | None:
    """The path up to where it has least room, and from there down the room's gradient until ``depth`` [m] deep.

    Where a limit of the joints, or a place from which no joint leads deeper, is met before, it leaves the path
    elsewhere, or in a random direction; None if that helps nowhere.
    """
    share = np.linspace(0.0, len(waypoints) - 1, 20 * len(waypoints))
    edge = np.minimum(share.astype(int), len(waypoints) - 2)
    q = waypoints[edge] + (share - edge)[:, None] * (waypoints[edge + 1] - waypoints[edge])
    nearest = np.argsort(arm_room(robot, table, q, _MOBILE), kind="stable")
    for k in nearest[:: max(1, len(nearest) // _LEAVES)]:
        out = _deeper(q[k], robot, table, depth)
        if out is not None:
            return np.concatenate([waypoints[: edge[k] + 1], out])
    k = int(nearest[0])
    out = _straight_in(q[k], robot, table, depth)
    return None if out is None else np.concatenate([waypoints[: edge[k] + 1], out])


def _straight_in(start: Array, robot: RobotModel, table: Tabletop, depth: float) -> Array | None:
    """Along the first of a hundred random directions of the joints that leads ``depth`` [m] into something."""
    rng = np.random.default_rng(0)
    far = np.linspace(0.0, 1.0, 251)[:, None]
    for _ in range(100):
        direction = rng.standard_normal(len(start))
        q = start + far * direction / np.linalg.norm(direction)
        q = q[((q >= robot.chain.lower) & (q <= robot.chain.upper)).all(axis=1)]
        deep = np.flatnonzero(arm_room(robot, table, q, _MOBILE) <= -depth)
        if len(deep):
            return np.stack([q[0], q[deep[0]]])
    return None


def _deeper(start: Array, robot: RobotModel, table: Tabletop, depth: float) -> Array | None:
    at = start.copy()
    out = [at.copy()]
    for _ in range(400):
        room = float(arm_room(robot, table, at[None], _MOBILE)[0])
        if room <= -depth:
            return np.array(out)
        probes = at + 1e-5 * np.eye(len(at))
        slope = (arm_room(robot, table, probes, _MOBILE) - room) / 1e-5
        length = float(np.linalg.norm(slope))
        if length < 1e-3:
            return None
        step = at - min(0.02, max(room + 1.2 * depth, 1e-3) / length) * slope / length
        at = np.clip(step, robot.chain.lower + 0.01, robot.chain.upper - 0.01)
        out.append(at.copy())
    return None


def _capsules(robot: RobotModel) -> list[tuple[int, Capsule]]:
    """Of the moving links, and of the fingers on the last one, in its frame."""
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
