"""What makes a grasp good: terms in 0..1, and their weighted mean."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.antipodal import Pairs
from splatbot.grasping.hands import Hands
from splatbot.grasping.reach import ROOM, Reached
from splatbot.grasping.volume import Volume
from splatbot.protocols import Array, HandShape

WEIGHTS: Mapping[str, float] = {
    # How far inside of the friction cone the places are where the pads touch: how much friction may be missing, and how
    # far off hand and map may be. What does not hold is of no use, however well it is reached.
    "closure": 6.0,
    "held": 2.0,  # how much of the pads is on the surface
    "centre": 2.0,  # how near the line between the contacts is to the target's centre of mass
    "torque": 4.0,  # how much of the pads' friction its weight leaves, which turns it about that line
    "width": 1.0,  # how much of the stroke is left
    "clear": 4.0,  # whether hand and arm keep clear of where something moved; only where something did
    "room": 2.0,  # of the hand to the target and to all else, on the way
    "seen": 2.0,  # how much of the contacts was measured, not implied
    "certain": 1.0,  # how well it is known where they are
    "upright": 0.5,  # how far from above the hand comes
    "near": 2.0,  # to what was pointed at
    "arm": 1.0,  # room of the whole arm along the approach
    "limits": 1.0,  # of the joints
}

FAR = 0.05  # [m] from the middle, or from what was pointed at, that is as bad as farther
_SPARE = 0.02  # [m] of the stroke left that is as good as more
_ROOM = 0.02  # [m] of the hand that is as good as more
_DOUBT = 0.004  # [m] of uncertainty that is as bad as more
_DENSITY = 1000.0  # [kg/m³] that is taken for granted: water's
_PULL = 2 * 9.81  # [m/s²]: its weight, and as much again as it is moved


def hand_terms(
    hands: Hands,
    pairs: Pairs,
    body: Volume,
    hand: HandShape,
    room: Array,
    *,
    friction: float,
    up: Array,
    near: Array | None,
) -> dict[str, Array]:
    """The terms (K,) that need no arm.

    Args:
        hands: with the pairs that they press.
        pairs: of contacts.
        body: the target's volume.
        hand: the fingers.
        room: (K,) of the whole hand [m].
        friction: coefficient.
        up: (3,) unit [world].
        near: (3,) [m, world] what was pointed at.
    """
    p = hands.pair
    middle = pairs.contacts[p].mean(axis=1)
    line = pairs.contacts[p, 1] - pairs.contacts[p, 0]
    line = line / np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-12)
    aside = np.linalg.norm(np.cross(body.center - middle, line), axis=1)
    found = {
        "closure": hands.closure,
        "held": hands.held,
        "centre": 1.0 - aside / FAR,
        "torque": 1.0 - friction_share(body.size * _DENSITY * _PULL, aside, hand, friction),
        "width": (hand.stroke - pairs.width[p]) / _SPARE,
        "room": room / _ROOM,
        "seen": pairs.seen[p],
        "certain": 1.0 - pairs.doubt[p] / _DOUBT,
        "upright": -(hands.T[:, :3, 2] @ up),
    }
    if near is not None:
        found["near"] = 1.0 - np.linalg.norm(pairs.contacts[p] - near, axis=2).min(axis=1) / FAR
    return {name: np.clip(values, 0.0, 1.0) for name, values in found.items()}


def friction_share(load: float, aside: Array, hand: HandShape, friction: float) -> Array:
    """How much of the friction of two pads a load takes that acts ``aside`` (K,) [m] of the line between them (K,).

    A soft pad resists a pull and a turn together as an ellipsoid bounds them (Howe & Cutkosky 1996):
    (f / mu N)² + (tau / (e mu N))² <= 1, with e two thirds of the radius of a round pad that presses evenly. Above 1 it
    slips or turns.

    Args:
        load: [N].
        aside: see there.
        hand: the fingers, whose force is all used.
        friction: coefficient mu.
    """
    lever = 2 / 3 * hand.width / 2
    return np.asarray(load / (2 * friction * hand.force) * np.hypot(1.0, aside / lever))


def arm_terms(reached: Reached) -> dict[str, float]:
    """The terms of an arm that gets there."""
    return {
        "arm": float(np.clip(reached.room / ROOM, 0.0, 1.0)),
        "limits": float(np.clip(3 * reached.limits, 0.0, 1.0)),
    }


def totals(terms: Mapping[str, Array]) -> Array:
    """Weighted means (K,) of the terms that there are."""
    weights = np.array([WEIGHTS[name] for name in terms])
    return np.asarray(np.stack(list(terms.values()), axis=-1) @ weights / weights.sum())


def best_apart(hands: Hands, total: Array, *, most: int) -> NDArray[np.int64]:
    """Rows of the best hands, best first, none within 8 mm and 15 degrees of a better one."""
    order = np.argsort(-total, kind="stable")
    kept: list[int] = []
    z, at = hands.T[:, :3, 2], hands.T[:, :3, 3]
    for row in order:
        if len(kept) == most:
            break
        if kept:
            near = np.linalg.norm(at[kept] - at[row], axis=1) < 0.008
            same = (z[kept] @ z[row] > np.cos(0.26)) & (
                np.abs(hands.T[kept, :3, 1] @ hands.T[row, :3, 1]) > np.cos(0.26)
            )
            if (near & same).any():
                continue
        kept.append(int(row))
    return np.array(kept, np.int64)
