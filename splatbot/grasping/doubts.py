"""Doubts about grasps that fit the map: measured evidence that is too weak to execute them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.grasping.measured import CONSTANTS
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.types import Grasp
from splatbot.protocols import Array, HandShape


@dataclass(frozen=True)
class PartConstants:
    """Constants of grasps of a part of a larger cluster.

    Args:
        beyond: [m] distance outside of the pads, along their closing direction, from which a point is beyond them.
        share: share of the target's surface beyond the pads from which the hand closes on a part of it.
    """

    beyond: float = 0.01
    share: float = 0.1


PART = PartConstants()


def part_note(grasp: Grasp, points: Array) -> str:
    """Return a note if the hand closes on a part of the target: much of its surface is outside of the pads.

    With the coordinate t along the mean normal of the contacts, from their middle, a point is beyond the pads if
    ``|t| > d / 2 + 1 cm``. The contacts are d apart along that normal. The closing direction may be tilted
    against the normals, by the friction cone, and would count the height of a tall object.

    Args:
        grasp: the grasp.
        points: (P, 3) on the surface of the target [m, world].
    """
    normal = grasp.normals[1] - grasp.normals[0]
    length = float(np.linalg.norm(normal))
    if length < 1e-6:
        return ""
    normal = normal / length
    apart = abs(float((grasp.contacts[1] - grasp.contacts[0]) @ normal))
    outside = np.abs((points - grasp.contacts.mean(axis=0)) @ normal) - apart / 2
    share = float((outside > PART.beyond).mean())
    if share < PART.share:
        return ""
    return (
        f"The first grasp closes on a part of the target: {share:.0%} of its surface is beyond the pads, up to "
        f"{1e3 * outside.max():.0f} mm. If objects touch there, mark the one to take in images of the run (--mask)."
    )


def doubt(grasp: Grasp, options: GraspOptions, hand: HandShape) -> str:
    """Return why a grasp should not be executed; empty if it may be."""
    if grasp.confidence < options.min_confidence:
        return f"has a confidence of {grasp.confidence:.2f}, less than {options.min_confidence:g}"
    if options.accept_implied or grasp.depth_distance is None or grasp.unseen is None or not any(grasp.implied):
        return ""
    if all(grasp.implied):
        if np.isinf(grasp.depth_distance).any():
            return "has no contact at measured depth, nor any depth near it"
        away = " and ".join(f"{1e3 * value:.0f}" for value in grasp.depth_distance)
        return f"has no contact at measured depth, which is {away} mm away"
    if hand.stroke - grasp.width < 2 * CONSTANTS.implied_gap:
        width, most = 1e3 * grasp.width, 1e3 * hand.stroke
        return f"is {width:.0f} mm wide at an implied contact, too close to the {most:.0f} mm that the hand opens"
    if any(grasp.blind):
        finger = grasp.blind.index(True)
        why = f"{grasp.unseen[finger]:.0%} of its face is in unseen space"
        away = f"{1e3 * grasp.depth_distance[finger]:.0f} mm from measured depth"
        return f"has a finger where the object may continue: {why}, {away}"
    return ""
