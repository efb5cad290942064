"""Doubts about grasps that fit the map: measured evidence that is too weak to execute them."""

from __future__ import annotations

import numpy as np

from splatbot.grasping.measured import CONSTANTS
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.types import Grasp
from splatbot.protocols import HandShape


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
