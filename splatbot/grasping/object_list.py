"""Labelled list of the supports and objects of a map, so that a target can be named."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatbot.geometry import inverse, transform_points
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.grasping.hands import usable_opening
from splatbot.grasping.language import label_of
from splatbot.planning.ik import ArmWithTool, solve_ik
from splatbot.protocols import Array, HasHand, RobotKinematics
from splatbot.segmentation import MapObject, SegmentedMap
from splatbot.segmentation.plane import NEAR


@dataclass(frozen=True)
class ObjectListConstants:
    """Constants of the list.

    Args:
        min_height: [m] height below which an object is a flat patch, which a hand cannot enclose.
        max_gap: [m] largest height of an object's lowest points above the support that it stands on. Undersides are
            seldom seen.
        ik_starts: number of starts of inverse kinematics for one pose of the tool.
    """

    min_height: float = 0.012
    max_gap: float = 0.03
    ik_starts: int = 64


CONSTANTS = ObjectListConstants()


@dataclass(frozen=True)
class Obstacle:
    """Reason why a hand cannot enclose an object, or an arm cannot reach it.

    Args:
        verdict: two words.
        reason: clause with the measured values.
    """

    verdict: str
    reason: str


@dataclass(frozen=True, eq=False)
class ListedObject:
    """One object of a map.

    Args:
        number: index; ``object NUMBER`` names it as a target.
        label: name of the scene file, or colour, shape and number. It names this object as a target.
        size: (3,) long side, short side and height [m].
        at_world, at_base: (3,) centre of the bounding box [m].
        gaussians: number of Gaussians.
        fits: whether the hand can enclose it.
        within_reach: whether a posture of the arm places the tool at its centre, without regard to obstacles. If None,
            the robot has no hand.
        on_support: whether it stands on a support of the map, and does not float or hang.
        verdict: "fits", or the obstacle in two words: "no hand", "too flat", "too wide", "too far" or "no pose".
        obstacle: reason why the hand cannot enclose it or the arm cannot reach it, or "".
    """

    number: int
    label: str
    size: Array = field(repr=False)
    at_world: Array = field(repr=False)
    at_base: Array = field(repr=False)
    gaussians: int = 0
    fits: bool = True
    within_reach: bool | None = None
    on_support: bool = True
    verdict: str = "fits"
    obstacle: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the values as JSON, each length with its unit in the name."""
        return {
            "number": self.number,
            "label": self.label,
            "target": f"object {self.number}",
            "size_m": self.size.round(4).tolist(),
            "center_world_m": self.at_world.round(4).tolist(),
            "center_base_m": self.at_base.round(4).tolist(),
            "gaussians": self.gaussians,
            "on_support": self.on_support,
            "graspable_by_size": self.fits,
            "within_reach": self.within_reach,
            "verdict": self.verdict,
            "obstacle": self.obstacle or None,
        }


def list_objects(scene: SegmentedMap, robot: RobotKinematics) -> tuple[ListedObject, ...]:
    """Return the objects of a map, those with most Gaussians first.

    Args:
        scene: the segmented map.
        robot: arm whose hand must enclose an object; without a hand, none fits.
    """
    T_base_world, stroke = inverse(scene.T_world_base), stroke_of(robot)
    found = []
    for item in scene.objects:
        at, by_size = transform_points(T_base_world, item.center), obstacle(item, stroke)
        beyond = _out_of_reach(at, float(np.linalg.norm(item.size)) / 2, robot)
        limit = by_size or beyond
        found.append(
            ListedObject(
                item.number,
                label_of(scene, item),
                item.size,
                item.center,
                at,
                len(item.rows),
                fits=by_size is None,
                within_reach=None if stroke <= 0.0 else beyond is None,
                on_support=_stands(scene, item),
                verdict=limit.verdict if limit else "fits",
                obstacle=limit.reason if limit else "",
            )
        )
    return tuple(found)


def list_planes(scene: SegmentedMap) -> list[dict[str, Any]]:
    """Return the supports of a map: height above the base, area of their bounding rectangle and points, as JSON."""
    planes = []
    for number, support in enumerate(scene.supports):
        on = scene.points[np.abs(support.height(scene.points)) < NEAR]
        low, high = np.percentile(on[:, :2], [1, 99], axis=0) if len(on) else np.zeros((2, 2))
        planes.append(
            {
                "label": "support" if number == 0 else f"support {number}",
                "normal_base": support.normal.round(4).tolist(),
                "height_base_m": round(float(support.offset), 4),
                "size_m": (high - low).round(4).tolist(),
                "gaussians": len(on),
            }
        )
    return planes


def stroke_of(robot: RobotKinematics) -> float:
    """Return the widest opening of a robot's hand [m], 0 without a hand."""
    hand = robot.hand if isinstance(robot, HasHand) else None
    return hand.stroke if hand is not None else 0.0


def _stands(scene: SegmentedMap, item: MapObject) -> bool:
    """Return whether the lowest points of an object are at most 3 cm above the highest support below them."""
    points = scene.points[item.rows]
    support = scene.under(points)
    return support is not None and float(np.percentile(support.height(points), 5)) <= CONSTANTS.max_gap


def _out_of_reach(center: Array, radius: float, robot: RobotKinematics) -> Obstacle | None:
    """Return why an arm cannot reach an object with a center (3,) [m, base frame] and a radius [m], or None.

    The tool is at most as far from the first joint as all links in line. Nearer objects need a posture that places the
    tool at the centre, with an approach from above, from the front or from a side.
    """
    if not isinstance(robot, ArmWithTool):
        return None
    reach = robot.chain.reach(robot.T_link_tcp)
    away = float(np.linalg.norm(center - robot.chain.T_before_joint[0, :3, 3])) - radius
    if away > reach:
        return Obstacle("too far", f"it is {away:.2f} m from the first joint, and the arm reaches {reach:.2f} m")
    if any(len(solve_ik(robot, T, seeds=16, most=CONSTANTS.ik_starts).q) for T in _approaches(center)):
        return None
    return Obstacle("no pose", "no posture places the tool at its centre from above, from the front or from a side")


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


def obstacle(item: MapObject, stroke: float) -> Obstacle | None:
    """Return why a hand that opens ``stroke`` [m] cannot enclose an object with a gap at each pad, or None."""
    if stroke <= 0.0:
        return Obstacle("no hand", "the robot has no hand")
    if item.size[2] < CONSTANTS.min_height:
        return Obstacle("too flat", f"it is flat, {1e3 * item.size[2]:.0f} mm high")
    if item.size[1] > usable_opening(stroke):
        gap = 1e3 * HANDS.min_pad_gap
        wide = f"its faces are {1e3 * item.size[1]:.0f} mm apart, and the hand opens {1e3 * stroke:.0f} mm"
        return Obstacle("too wide", f"{wide}, with {gap:.0f} mm of free space at each pad")
    return None
