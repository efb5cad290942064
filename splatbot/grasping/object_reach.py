"""Reach of objects: postures of an arm that take the tool to an object, free of the map and of the arm itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.grasping.obstacles import around_target
from splatbot.grasping.reach import hand_of
from splatbot.planning.causes import collision
from splatbot.planning.ik import ArmWithTool, solve_ik
from splatbot.planning.problem import Cause
from splatbot.protocols import Array, RobotKinematics
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


class _Clearance:
    """Check of postures against the map without an object, and against the arm itself.

    The links before the hand keep the margin. The hand is as open as the object requires. It keeps no margin, and may
    touch the support of the object, because the height of a grasp is not known yet.
    """

    def __init__(
        self, scene: SegmentedMap, item: MapObject, robot: RobotKinematics, margin: float, solids: GaussianModel | None
    ) -> None:
        around = around_target(scene, item.rows)
        of_links = around if solids is None else GaussianModel.concatenate([around, solids])
        of_hand = around_target(scene, np.concatenate([item.rows, _rows_of_support(scene, item)]))
        opening = min(float(item.size[1]) + 2 * HANDS.min_pad_gap, hand_of(robot).stroke)
        arm = RobotSpheres(robot, T_world_base=scene.T_world_base, opening=opening)
        self._checks = (
            (arm, GaussianCollisionField(of_hand), "the map"),
            (
                arm.without_hand(margin),
                GaussianCollisionField(of_links),
                f"the map or its {1e3 * margin:.1f} mm margin",
            ),
        )
        self._met: list[Array] = []

    def free(self, q: Array) -> NDArray[np.bool_]:
        """Return whether each configuration (K, J) is free; the first ones that are not are kept."""
        meets = np.any([spheres.check(field, q).in_collision for spheres, field, _ in self._checks], axis=0)
        self._met.extend(q[meets][: CONSTANTS.causes - len(self._met)])
        return np.asarray(~meets)

    def cause(self) -> str | None:
        """Return the deepest contact of the posture in which it is least deep, or None if no posture was found."""
        if not self._met:
            return None
        deepest = [
            max(((collision(spheres, field, q), where) for spheres, field, where in self._checks), key=_depth)
            for q in self._met
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
    if any(len(solve_ik(robot, T, seeds=seeds, most=starts, free=clear.free).q) for T in _approaches(center)):
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
