"""Labelled list of the supports and objects of a map, so that a target can be named."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.grasping.hands import usable_opening
from splatbot.grasping.language import STRUCTURE, label_of
from splatbot.grasping.object_reach import Obstacle, out_of_reach
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
    """

    min_height: float = 0.012
    max_gap: float = 0.03


CONSTANTS = ObjectListConstants()
NO_HAND = "no hand"


@dataclass(frozen=True, eq=False)
class ListedObject:
    """One object of a map.

    Args:
        number: index; ``object NUMBER`` names it as a target.
        label: name of the scene file, or colour, shape and number. It names this object as a target.
        size: (3,) long side, short side and height [m].
        at_world, at_base: (3,) centre of the bounding box [m].
        gaussians: number of Gaussians.
        on_support: whether it stands on a support of the map, and does not float or hang.
        of_hand: why the hand cannot enclose it: "no hand", "too flat" or "too wide". If None, it fits.
        of_arm: why the arm cannot reach it: "blocked", "no pose" or "too far". If None, it can, or the robot has
            no hand.
        structure: why it is structure and no target, see :func:`splatbot.grasping.structure.find_structures`; empty
            for an object.
    """

    number: int
    label: str
    size: Array = field(repr=False)
    at_world: Array = field(repr=False)
    at_base: Array = field(repr=False)
    gaussians: int = 0
    on_support: bool = True
    of_hand: Obstacle | None = None
    of_arm: Obstacle | None = None
    structure: str = ""

    @property
    def fits(self) -> bool:
        """Return whether the hand can enclose it by its size."""
        return self.of_hand is None

    @property
    def reach(self) -> str | None:
        """Return "yes", or the verdict on the arm; None for structure, and for a robot without a hand."""
        if self.structure or (self.of_hand is not None and self.of_hand.verdict == NO_HAND):
            return None
        return "yes" if self.of_arm is None else self.of_arm.verdict

    @property
    def obstacle(self) -> Obstacle | None:
        """Return why it cannot be grasped, first that of the hand."""
        return self.of_hand or self.of_arm

    def to_dict(self) -> dict[str, Any]:
        """Return the values as JSON, each length with its unit in the name."""
        return {
            "number": self.number,
            "kind": STRUCTURE if self.structure else "object",
            "label": self.label,
            "target": None if self.structure else f"object {self.number}",
            "size_m": self.size.round(4).tolist(),
            "center_world_m": self.at_world.round(4).tolist(),
            "center_base_m": self.at_base.round(4).tolist(),
            "gaussians": self.gaussians,
            "on_support": self.on_support,
            "graspable_by_size": self.fits,
            "reach": self.reach,
            "verdict": STRUCTURE if self.structure else self.obstacle.verdict if self.obstacle else "fits",
            "obstacle": self.structure or (self.obstacle.reason if self.obstacle else None),
        }


def list_objects(
    scene: SegmentedMap, robot: RobotKinematics, *, margin: float = 0.0, solids: GaussianModel | None = None
) -> tuple[ListedObject, ...]:
    """Return the objects of a map, those with most Gaussians first.

    Args:
        scene: the segmented map.
        robot: arm whose hand must enclose an object and which must reach it; without a hand, none fits.
        margin: clearance [m] that the links before the hand keep from the map, as plans do.
        solids: obstacles of the arm that are not in the map, as the support plane of its scene.yaml.
    """
    T_base_world, stroke = inverse(scene.T_world_base), stroke_of(robot)
    found = []
    for item in scene.objects:
        structure = scene.structures.get(item.number, "")
        sought = stroke > 0.0 and not structure
        reached = out_of_reach(scene, item, robot, margin=margin, solids=solids) if sought else None
        found.append(
            ListedObject(
                item.number,
                label_of(scene, item),
                item.size,
                item.center,
                transform_points(T_base_world, item.center),
                len(item.rows),
                on_support=_stands(scene, item),
                of_hand=obstacle(item, stroke),
                of_arm=reached,
                structure=structure,
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


def obstacle(item: MapObject, stroke: float) -> Obstacle | None:
    """Return why a hand that opens ``stroke`` [m] cannot enclose an object with a gap at each pad, or None."""
    if stroke <= 0.0:
        return Obstacle(NO_HAND, "the robot has no hand")
    if item.size[2] < CONSTANTS.min_height:
        return Obstacle("too flat", f"it is flat, {1e3 * item.size[2]:.0f} mm high")
    if item.size[1] > usable_opening(stroke):
        gap = 1e3 * HANDS.min_pad_gap
        wide = f"its faces are {1e3 * item.size[1]:.0f} mm apart, and the hand opens {1e3 * stroke:.0f} mm"
        return Obstacle("too wide", f"{wide}, with {gap:.0f} mm of free space at each pad")
    return None
