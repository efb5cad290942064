"""Paths among meshes and octrees: the arm's capsules against them by python-fcl at discrete configurations."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import RobotSpheres
from splatbot.geometry import inverse
from splatbot.grasping.affordance import Target
from splatbot.grasping.attached import within
from splatbot.grasping.lift import in_hand, raised, target_spheres
from splatbot.grasping.pick_planner import PickPlan, Segment
from splatbot.grasping.pick_types import PickOptions
from splatbot.grasping.reach import Reached
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import Grasp
from splatbot.planning import JointGoal, Path
from splatbot.planning.cartesian import straight_line
from splatbot.planning.ik import solve_ik
from splatbot.planning.problem import Certificate
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.robots.shapes import Capsule
from splatbot.sim.trials.discrete import CONSTANTS as DISCRETE
from splatbot.sim.trials.discrete import Free, connect


@dataclass(frozen=True)
class SolidStackConstants:
    """Constants of plans on meshes and voxels.

    Args:
        max_planning_time: [s] time limit of the first path.
        ik_seeds: seeds of inverse kinematics.
    """

    max_planning_time: float = 2.0
    ik_seeds: int = 8


CONSTANTS = SolidStackConstants()


@dataclass(frozen=True, eq=False)
class SolidWorld:
    """Obstacles of an arm as python-fcl geometries.

    Args:
        points: (P, 3) of the surface [m].
        whole: geometry of all points.
        around: returns the geometry without the given rows.
    """

    points: Array
    whole: Any
    around: Callable[[NDArray[np.int64]], Any]


class SolidArm:
    """An arm's capsules, except those of the base, against a python-fcl geometry and against itself.

    Args:
        robot: with capsules.
        T_world_base: (4, 4).
        opening: of the fingers [m].
        world: the geometry.
        attached: (A, 4) spheres of a held object in the last link's frame.
    """

    def __init__(
        self, robot: RobotModel, T_world_base: Array, opening: float, world: Any, attached: Array | None = None
    ) -> None:
        fcl = importlib.import_module("fcl")
        self._fcl = fcl
        self.spheres = RobotSpheres(robot, T_world_base=T_world_base, opening=opening)
        self._world = fcl.CollisionObject(world, fcl.Transform())
        self._parts = [(link, T, fcl.CollisionObject(shape, fcl.Transform())) for link, T, shape in
                       (*_capsules(fcl, robot, opening), *_held(fcl, robot, attached))]  # fmt: skip

    def free(self, q: Array) -> NDArray[np.bool_]:
        """Return which configurations (C, J) are without contact."""
        good = ~self.spheres.check(None, q).in_collision
        poses = self.spheres.forward(q)
        for c in np.flatnonzero(good):
            good[c] = not any(self._hit(poses[c, link] @ T, part) for link, T, part in self._parts)
        return np.asarray(good)

    def _hit(self, T: Array, part: Any) -> bool:
        part.setTransform(self._fcl.Transform(T[:3, :3], T[:3, 3]))
        return bool(self._fcl.collide(self._world, part, self._fcl.CollisionRequest(), self._fcl.CollisionResult()))


class SolidReach:
    """Reachability check of grasps; see :class:`splatbot.grasping.reach.Reach`.

    Args:
        robot: the arm.
        T_world_base: (4, 4).
        world: obstacles.
        rows: of the target.
    """

    def __init__(self, robot: RobotModel, T_world_base: Array, world: SolidWorld, rows: NDArray[np.int64]) -> None:
        self.robot, self.T, self.world = robot, T_world_base, world
        self._around = world.around(rows)

    def reach(self, T_world_tcp: Array, T_world_pregrasp: Array, opening: float, width: float) -> Reached:
        """Implement :meth:`splatbot.grasping.reach.Reach.reach`."""
        near = SolidArm(self.robot, self.T, opening, self._around)
        far = SolidArm(self.robot, self.T, opening, self.world.whole)
        closed = SolidArm(self.robot, self.T, width, self._around)
        chain = self.robot.chain
        found = solve_ik(
            self.robot, inverse(self.T) @ T_world_tcp, near=(chain.lower + chain.upper) / 2, seeds=CONSTANTS.ik_seeds
        ).q
        if not len(found):
            return Reached(None, None, 0.0, 0.0, "no posture reaches it", "no posture reaches")
        found = found[near.free(found)]
        if not len(found):
            return Reached(None, None, 0.0, 0.0, "the arm is in the way of it", "the arm is in the way of")
        for q in found:
            path = straight(near, near.free, q, T_world_pregrasp)
            if path is not None and far.free(path[-1:])[0] and closed.free(q[None])[0]:
                half = (chain.upper - chain.lower) / 2
                limits = float((np.minimum(q - chain.lower, chain.upper - q) / half).min())
                return Reached(q, path[::-1].copy(), 0.0, limits)
        return Reached(None, None, 0.0, 0.0, "its approach is blocked", "have a blocked approach")


class SolidPickPlanner:
    """Planner of paths to grasps; see :class:`splatbot.grasping.pick_planner.PickPlanner`.

    Args:
        sampler: of the grasps.
        target: object to pick.
        options: of the pick.
        world: obstacles.
    """

    def __init__(self, sampler: GraspSampler, target: Target, options: PickOptions, world: SolidWorld) -> None:
        assert isinstance(sampler.robot, RobotModel)
        self.s, self.o, self.world, self.robot = sampler, options, world, sampler.robot
        self._T = sampler.scene.T_world_base
        self._around = world.around(target.rows)
        self._object = target_spheres(sampler, target)
        own = within(world.points, self._object)
        own[target.rows] = True
        self._without_object = world.around(np.flatnonzero(own))

    def plan_to(self, grasp: Grasp, start: Array, *, avoid_moving: bool = False) -> PickPlan | str:
        """Plan a pick; see :class:`splatbot.grasping.pick_planner.PickPlanner`."""
        if grasp.q_pregrasp is None:
            return "no posture is known"
        opening = min(grasp.opening, self.s.hand.stroke)
        far = SolidArm(self.robot, self._T, opening, self.world.whole)
        begin = time.perf_counter()
        to_pregrasp = self._connect(far, start, grasp.q_pregrasp)
        planning_seconds = time.perf_counter() - begin
        if to_pregrasp is None:
            return "no path was found"
        near = SolidArm(self.robot, self._T, opening, self._around)
        approach = straight(near, near.free, grasp.q_pregrasp, grasp.T_world_tcp)
        if approach is None:
            return "its approach is blocked"
        q = approach[-1]
        closed = SolidArm(self.robot, self._T, grasp.width, self._without_object)
        attached = in_hand(closed.spheres, q, self._object)
        lift_off = straight(closed, closed.free, q, raised(self.s, closed.spheres, q, self.o.lift_off))
        if lift_off is None:
            return "it cannot be lifted"
        loaded = SolidArm(self.robot, self._T, grasp.width, self._without_object, attached)
        top = raised(self.s, closed.spheres, lift_off[-1], self.o.lift - self.o.lift_off)
        lift = straight(loaded, loaded.free, lift_off[-1], top)
        if lift is None:
            return "it cannot be lifted"
        return PickPlan(
            grasp,
            opening,
            attached,
            _segment(to_pregrasp, far),
            _segment(approach, near),
            _segment(lift_off, closed),
            _segment(lift, closed),
            planning_seconds,
        )

    def plan_carry(self, plan: PickPlan, start: Array, goal: JointGoal) -> Segment | str:
        """Plan the motion after a pick; see :class:`splatbot.grasping.pick_planner.PickPlanner`."""
        loaded = SolidArm(self.robot, self._T, plan.grasp.width, self._without_object, plan.attached)
        path = self._connect(loaded, start, np.asarray(goal.q, dtype=np.float64))
        return "no path was found" if path is None else _segment(path, loaded)

    def _connect(self, arm: SolidArm, start: Array, goal: Array) -> Array | None:
        if not arm.free(np.stack([start, goal])).all():
            return None
        chain = self.robot.chain
        path = connect(
            arm.free, chain.lower, chain.upper, start, goal, seconds=CONSTANTS.max_planning_time, seed=self.o.seed
        )
        return path if len(path) else None


def straight(arm: SolidArm, free: Free, start: Array, T_world_end: Array) -> Array | None:
    """Return the configurations (K, J) along the tool's straight line, if all of them are free."""
    line = straight_line(arm.spheres, None, start, T_world_end)
    if not line or line.path is None:
        return None
    return line.path.waypoints if free(line.path.waypoints).all() else None


def _segment(path: Array, arm: SolidArm) -> Segment:
    """Sample the waypoints densely, so that corners are hardly rounded; the deviation is not certified."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    parts = [
        a
        + np.linspace(0.0, 1.0, max(1, int(np.ceil(length / (4 * DISCRETE.resolution)))), endpoint=False)[:, None]
        * (b - a)
        for a, b, length in zip(path[:-1], path[1:], steps, strict=True)
    ]
    dense = np.concatenate([*parts, path[-1:]])
    return Segment(
        Path(dense, float(steps.sum()), Certificate(False, DISCRETE.resolution, 0.0, 0.0, -1)), arm.spheres, None
    )


def _capsules(fcl: Any, robot: RobotModel, opening: float) -> list[tuple[int, Array, Any]]:
    """Link, pose in it (4, 4), and geometry of every capsule but the base's."""
    found = [
        (shape.link, *_capsule(fcl, np.array(shape.start), np.array(shape.end), shape.radius))
        for shape in robot.shapes
        if isinstance(shape, Capsule) and shape.link > 0
    ]
    if robot.gripper is not None:
        out = np.array([0.0, opening / 2, 0.0])
        for T in robot.gripper.T_link_finger:
            for shape in robot.gripper.shapes:
                if isinstance(shape, Capsule):
                    own, geometry = _capsule(fcl, np.array(shape.start) + out, np.array(shape.end) + out, shape.radius)
                    found.append((len(robot.chain), T @ own, geometry))
    return found


def _capsule(fcl: Any, start: Array, end: Array, radius: float) -> tuple[Array, Any]:
    T = np.eye(4)
    T[:3, 3] = (start + end) / 2
    length = float(np.linalg.norm(end - start))
    if length > 0:
        z = (end - start) / length
        x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
        x /= np.linalg.norm(x)
        T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return T, fcl.Capsule(radius, length)


def _held(fcl: Any, robot: RobotModel, attached: Array | None) -> list[tuple[int, Array, Any]]:
    found = []
    for x, y, z, radius in np.zeros((0, 4)) if attached is None else attached:
        T = np.eye(4)
        T[:3, 3] = x, y, z
        found.append((len(robot.chain), T, fcl.Sphere(float(radius))))
    return found
