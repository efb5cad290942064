"""Grasp score: terms in 0..1 and their weighted mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.antipodal import Pairs
from splatbot.grasping.hands import Hands
from splatbot.grasping.reach import CONSTANTS as REACH
from splatbot.grasping.reach import Reached
from splatbot.grasping.volume import Volume
from splatbot.protocols import Array, HandShape

WEIGHTS: Mapping[str, float] = {
    # Force-closure margin of the points that the pads touch. It absorbs errors of the friction coefficient, the hand
    # pose and the map. It has the largest weight, since no other term matters for a grasp that slips.
    "closure": 6.0,
    "held": 2.0,  # pad coverage
    "centre": 2.0,  # distance of the line of the contacts from the centre of mass
    "torque": 4.0,  # remaining friction after the load of the object's weight
    "width": 1.0,  # remaining stroke
    "clear": 4.0,  # whether hand and arm avoid regions where motion was observed; absent without such regions
    "clearance": 2.0,  # clearance of the hand along the approach
    "seen": 2.0,  # observed fraction of the surface at the contacts
    "measured": 1.0,  # fraction of the contacts at confirmed points of raw depth; absent without raw depth
    "certain": 1.0,  # standard deviation of the surface at the contacts
    "upright": 0.5,  # cosine between the approach direction and down
    "near": 2.0,  # distance of the contacts from the indicated point; absent without one
    "arm": 1.0,  # clearance of the arm along the approach
    "limits": 1.0,  # distance from the joint limits
}
"""Weight of each score term; the names are fields of results over HTTP."""

ZERO_SCORE_DISTANCE_M = 0.05  # from the centre of mass, or from the indicated point, at which a term is 0


@dataclass(frozen=True)
class ScoreConstants:
    """Constants of the score terms.

    Args:
        full_score_stroke: [m] remaining stroke with the score 1.
        hand_full_score_clearance: [m] clearance of the hand with the score 1.
        zero_score_std: [m] standard deviation of the surface with the score 0.
        density: [kg/m³] assumed density of the target, that of water.
        load_acceleration: [m/s²] gravity plus an equal acceleration of the arm.
        confidence_slope, confidence_offset: logistic fit of success in the held-out twin over the total score, from 198
            grasps in the scenes 300 to 344 (`splatbot bench grasping --reliability 45 --first 300` prints a fit).
        similar_distance: [m] maximum distance between the tools of similar grasps.
        similar_angle: [rad] maximum angle between the axes of similar grasps.
    """

    full_score_stroke: float = 0.02
    hand_full_score_clearance: float = 0.02
    zero_score_std: float = 0.004
    density: float = 1000.0
    load_acceleration: float = 2 * 9.81
    confidence_slope: float = 10.1
    confidence_offset: float = -3.1
    similar_distance: float = 0.008
    similar_angle: float = 0.26


CONSTANTS = ScoreConstants()


def hand_terms(
    hands: Hands,
    pairs: Pairs,
    body: Volume,
    hand: HandShape,
    clearance: Array,
    *,
    friction: float,
    up: Array,
    near: Array | None,
) -> dict[str, Array]:
    """Compute the score terms (K,) that do not depend on the arm.

    Let a be the distance of the contact line from the centre of mass and z the approach direction. Let b be the
    distance of the nearest contact from the indicated point. The terms are clipped to 0..1::

        centre = 1 - a / 5 cm          torque = 1 - load / friction limit, see friction_load
        width = (stroke - width) / 2 cm    clearance = clearance / 2 cm
        certain = 1 - std / 4 mm       upright = -z · up       near = 1 - b / 5 cm

    Args:
        hands: hand poses.
        pairs: their contact pairs.
        body: volume of the target.
        hand: shape of the hand.
        clearance: (K,) clearance of the whole hand [m].
        friction: friction coefficient mu.
        up: (3,) unit up axis [world].
        near: (3,) indicated point [m, world]. If None, the term is absent.
    """
    p = hands.pair
    middle = pairs.contacts[p].mean(axis=1)
    line = pairs.contacts[p, 1] - pairs.contacts[p, 0]
    line = line / np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-12)
    aside = np.linalg.norm(np.cross(body.center - middle, line), axis=1)
    found = {
        "closure": hands.closure,
        "held": hands.pad_coverage,
        "centre": 1.0 - aside / ZERO_SCORE_DISTANCE_M,
        "torque": 1.0
        - friction_load(body.size * CONSTANTS.density * CONSTANTS.load_acceleration, aside, hand, friction),
        "width": (hand.stroke - pairs.width[p]) / CONSTANTS.full_score_stroke,
        "clearance": clearance / CONSTANTS.hand_full_score_clearance,
        "seen": pairs.observed[p],
        "certain": 1.0 - pairs.normal_std[p] / CONSTANTS.zero_score_std,
        "upright": -(hands.T[:, :3, 2] @ up),
    }
    if near is not None:
        found["near"] = 1.0 - np.linalg.norm(pairs.contacts[p] - near, axis=2).min(axis=1) / ZERO_SCORE_DISTANCE_M
    return {name: np.clip(values, 0.0, 1.0) for name, values in found.items()}


def friction_load(load: float, aside: Array, hand: HandShape, friction: float) -> Array:
    """Return the fraction (K,) of the friction limit of two soft pads that a load takes.

    An ellipsoid approximates the limit surface of a soft contact (Howe and Cutkosky 1996). With the tangential force f,
    the torque tau about the normal and the normal force N::

        (f / (mu N))² + (tau / (e mu N))² <= 1

    The lever e is two thirds of the radius of a round pad with uniform pressure. Each pad carries half of the load and
    its torque. Above 1 the object slips or rotates.

    Args:
        load: [N].
        aside: (K,) distance of the load from the line between the pads [m].
        hand: shape of the hand; its maximum force is used.
        friction: friction coefficient mu.
    """
    lever = 2 / 3 * hand.width / 2
    return np.asarray(load / (2 * friction * hand.force) * np.hypot(1.0, aside / lever))


def arm_terms(reached: Reached) -> dict[str, float]:
    """Compute the score terms of an arm that reaches the grasp."""
    return {
        "arm": float(np.clip(reached.clearance / REACH.full_score_clearance, 0.0, 1.0)),
        "limits": float(np.clip(3 * reached.limits, 0.0, 1.0)),
    }


def totals(terms: Mapping[str, Array]) -> Array:
    """Compute the weighted mean (K,) of the given terms: sum_i w_i t_i / sum_i w_i."""
    weights = np.array([WEIGHTS[name] for name in terms])
    return np.asarray(np.stack(list(terms.values()), axis=-1) @ weights / weights.sum())


def confidence(total: float) -> float:
    """Return the share 0..1 of grasps of a total score that succeed in the held-out twin.

    P = 1 / (1 + exp(-(a s + b))) (Platt 1999). Simulated grasps calibrate it; they say nothing about a wrong map.
    """
    return float(1 / (1 + np.exp(-(CONSTANTS.confidence_slope * total + CONSTANTS.confidence_offset))))


def suppress_similar(hands: Hands, total: Array, *, most: int) -> NDArray[np.int64]:
    """Return the indices of the best hands, best first, without those within 8 mm and 15 degrees of a better one."""
    order = np.argsort(-total, kind="stable")
    kept: list[int] = []
    z, at = hands.T[:, :3, 2], hands.T[:, :3, 3]
    for row in order:
        if len(kept) == most:
            break
        if kept:
            near = np.linalg.norm(at[kept] - at[row], axis=1) < CONSTANTS.similar_distance
            same = (z[kept] @ z[row] > np.cos(CONSTANTS.similar_angle)) & (
                np.abs(hands.T[kept, :3, 1] @ hands.T[row, :3, 1]) > np.cos(CONSTANTS.similar_angle)
            )
            if (near & same).any():
                continue
        kept.append(int(row))
    return np.array(kept, np.int64)
