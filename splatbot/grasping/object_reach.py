"""Reach of objects: postures of an arm that take the tool to an object, free of the map and of the arm itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.grasping.obstacles import around_target
from splatbot.grasping.reach import with_hand
from splatbot.planning.causes import collision
from splatbot.planning.ik import ArmWithTool, solve_ik
from splatbot.planning.problem import Cause
from splatbot.protocols import Array, LinkSpheres, RobotKinematics
from splatbot.segmentation import MapObject, SegmentedMap


@dataclass(frozen=True)
class ObjectReachConstants:
    """Constants of the reach of objects.

    Args:
        seeds: number of starts of inverse kinematics between two checks for a free posture.
        starts: largest number of starts for one pose of the tool.
        causes: largest number of colliding postures of which the least deep is reported.
    """

    seeds: int = 16
    starts: int = 64
    causes: int = 8


CONSTANTS = ObjectReachConstants()


@dataclass(frozen=True)
class Obstacle:
    """Reason why a hand cannot enclose an object, or an arm cannot reach it.

    Args:
        verdict: a word or two.
        reason: clause with the measured values.
    """

    verdict: str
    reason: str


class _Palm:
    """The hand of an arm without its fingers, which are the spheres that the opening moves, as a robot for checks."""

    def __init__(self, robot: RobotKinematics) -> None:
        self.name, self.chain, self.home = robot.name, robot.chain, robot.home
        self.self_collision_pairs = np.zeros((0, 2), np.int32)
        wide, closed = robot.spheres(), robot.spheres(0.0)
        keep = (wide.link == len(robot.chain)) & (wide.centers == closed.centers).all(axis=1)
        self._spheres = LinkSpheres(wide.link[keep], wide.centers[keep], wide.radii[keep])

    def spheres(self, opening: float | None = None) -> LinkSpheres:
        """Return the spheres, the same for every opening."""
        return self._spheres


@dataclass(frozen=True, eq=False)
class _Check:
    """Check of the spheres of some links against obstacles.

    Args:
        spheres: the links.
        field: the obstacles.
        name: their name.
    """

    spheres: RobotSpheres
    field: GaussianCollisionField
    name: str


class _Clearance:
    """Check of postures against the map without an object, and against the arm itself.

    The links before the hand keep the margin. The hand is as open as the object requires, and keeps no margin. From
    above its fingers may touch the support of the object, because the height of a grasp is not known yet.
    """

    def __init__(
        self, scene: SegmentedMap, item: MapObject, robot: RobotKinematics, margin: float, solids: GaussianModel | None
    ) -> None:
        around = around_target(scene, item.rows)
        whole = GaussianCollisionField(around if solids is None else GaussianModel.concatenate([around, solids]))
        of_fingers = around_target(scene, np.concatenate([item.rows, _rows_of_support(scene, item)]))
        _, hand = with_hand(robot)
        opening = min(float(item.size[1]) + 2 * HANDS.min_pad_gap, hand.stroke)
        arm = RobotSpheres(robot, T_world_base=scene.T_world_base, opening=opening)
        palm = RobotSpheres(_Palm(robot), T_world_base=scene.T_world_base)
        links = _Check(arm.without_hand(margin), whole, f"the map or its {1e3 * margin:.1f} mm margin")
        fingers = _Check(arm, GaussianCollisionField(of_fingers), "the map")
        self._from_above = (fingers, _Check(palm, whole, "the map"), links)
        self._level = (_Check(arm, whole, "the map"), links)
        self._met: list[tuple[Array, tuple[_Check, ...]]] = []

    def free_at(self, T_base_tool: Array) -> Callable[[Array], NDArray[np.bool_]]:
        """Return a function that checks postures (K, J) which place the tool at a pose (4, 4): free or not (K,).

        The first postures that are not free are kept for :meth:`cause`.
        """
        checks = self._from_above if T_base_tool[2, 2] < -0.5 else self._level

        def free(q: Array) -> NDArray[np.bool_]:
            meets = np.any([check.spheres.check(check.field, q).in_collision for check in checks], axis=0)
            self._met.extend((each, checks) for each in q[meets][: CONSTANTS.causes - len(self._met)])
            return np.asarray(~meets)

        return free

    def cause(self) -> str | None:
        """Return the deepest contact of the posture in which it is least deep, or None if no posture was found."""
        if not self._met:
            return None
        deepest = [
            max(((collision(check.spheres, check.field, q), check.name) for check in checks), key=_depth)
            for q, checks in self._met
        ]
        least, where = min(deepest, key=_depth)
        return least.deep_in(where) if least.gaussian >= 0 else str(least)


def _depth(found: tuple[Cause, str]) -> float:
    return found[0].depth


def _rows_of_support(scene: SegmentedMap, item: MapObject) -> NDArray[np.int64]:
    """Return the rows (M,) of the support on which an object stands."""
    under = scene.under(scene.points[item.rows])
    own = [-2 - k for k, support in enumerate(scene.supports) if support is under]
    return np.flatnonzero(np.isin(scene.labels, own))


def out_of_reach(
    scene: SegmentedMap,
    item: MapObject,
    robot: RobotKinematics,
    *,
    margin: float = 0.0,
    solids: GaussianModel | None = None,
) -> Obstacle | None:
    """Return why an arm cannot reach an object, or None.

    The tool is at most as far from the first joint as all links in line. Nearer objects need a free posture that places
    the tool at the centre, with an approach from above, from the front or from a side. The object is no obstacle.
    From above, the fingers may be in its support, and the rest of the hand may not.

    Args:
        scene: the segmented map.
        item: the object.
        robot: arm with a hand.
        margin: clearance [m] that the links before the hand keep from the map.
        solids: obstacles that are not in the map.
    """
    if not isinstance(robot, ArmWithTool):
        return None
    center = transform_points(inverse(scene.T_world_base), item.center)
    reach, radius = robot.chain.reach(robot.T_link_tcp), float(np.linalg.norm(item.size)) / 2
    away = float(np.linalg.norm(center - robot.chain.T_before_joint[0, :3, 3])) - radius
    if away > reach:
        return Obstacle("too far", f"it is {away:.2f} m from the first joint, and the arm reaches {reach:.2f} m")
    clear = _Clearance(scene, item, robot, margin, solids)
    seeds, starts = CONSTANTS.seeds, CONSTANTS.starts
    if any(len(solve_ik(robot, T, seeds=seeds, most=starts, free=clear.free_at(T)).q) for T in _approaches(center)):
        return None
    cause = clear.cause()
    if cause is None:
        return Obstacle("no pose", "no posture places the tool at its centre from above, from the front or from a side")
    return Obstacle("blocked", f"no posture found that places the tool at its centre is free: {cause}")


def _approaches(center: Array) -> list[Array]:
    """Return tool poses (4, 4) at a point (3,): from above, front and sides, with fingers closing in two directions."""
    away = np.array([center[0], center[1], 0.0])
    front = away / np.linalg.norm(away) if np.linalg.norm(away) > 0.0 else np.array([1.0, 0.0, 0.0])
    down, side = np.array([0.0, 0.0, -1.0]), np.array([-front[1], front[0], 0.0])
    poses = []
    for z, y in ((down, side), (down, front), (front, side), (front, down), (side, front), (side, down), (-side, down)):
        T = np.eye(4)
        T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        T[:3, 3] = center
        poses.append(T)
    return poses
