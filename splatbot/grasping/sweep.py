"""Collision of the hand with fields of Gaussians along its straight approach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, boxes_in_collision
from splatbot.geometry import inverse, rotation_to_quat, transform_points
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.grasping.hands import Hands
from splatbot.protocols import ArmWithHand, Array, HandShape


@dataclass(frozen=True)
class SweepConstants:
    """Constants of the swept approach of a hand.

    Args:
        samples: poses along the approach.
        batch: hands that are evaluated at once; it bounds memory.
        box_tolerance: [m] tolerance of box queries, and cut-off of the quick finger test.
    """

    samples: int = 5
    batch: int = 4096
    box_tolerance: float = 1e-3


CONSTANTS = SweepConstants()


def swept_clearance(robot: ArmWithHand, hands: Hands, field: GaussianCollisionField, *, retreat: float) -> Array:
    """Compute the clearance (K,) [m] of the last link's spheres at five poses of an approach of ``retreat`` [m].

    Values are clipped to 3 cm. The continuous path between the poses is certified later for the whole arm, see
    :func:`splatbot.planning.cartesian.straight_line`.
    """
    return _clearance(robot, hands, field, back=np.linspace(0.0, retreat, CONSTANTS.samples), cut=HANDS.max_clearance)


def finger_clearance(robot: ArmWithHand, hands: Hands, field: GaussianCollisionField, hand: HandShape) -> Array:
    """Compute the clearance (K,) [m] of the finger spheres at the grasp, clipped to 1 mm; a quick test."""
    return _clearance(robot, hands, field, back=np.zeros(1), cut=CONSTANTS.box_tolerance, ahead=-hand.palm)


def _clearance(
    robot: ArmWithHand,
    hands: Hands,
    field: GaussianCollisionField,
    *,
    back: Array,
    cut: float,
    ahead: float = -np.inf,
) -> Array:
    """Compute clearances (K,) [m], at most ``cut``, at offsets ``back`` (B,) [m] against the approach direction.

    Only spheres with z > ``ahead`` [m] in the frame of the tool count.
    """
    T_tcp_link = inverse(robot.T_link_tcp)
    clearance = np.full(len(hands), cut)
    alike = (np.flatnonzero(hands.opening == opening) for opening in np.unique(hands.opening))
    for rows in (some[k : k + CONSTANTS.batch] for some in alike for k in range(0, len(some), CONSTANTS.batch)):
        spheres = robot.spheres(float(hands.opening[rows[0]]))
        own = spheres.link == len(robot.chain)
        local, radii = transform_points(T_tcp_link, spheres.centers[own]), spheres.radii[own]
        local, radii = local[local[:, 2] > ahead], radii[local[:, 2] > ahead]
        places = (local[None] - back[:, None, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)
        T = hands.T[rows]
        centers = np.einsum("kij,sj->ksi", T[:, :3, :3], places) + T[:, None, :3, 3]
        wide = np.broadcast_to(np.tile(radii, len(back)), centers.shape[:2])
        away = field.clearance(np.c_[centers.reshape(-1, 3), wide.reshape(-1)], cut=cut).distance
        clearance[rows] = np.minimum(away.reshape(len(rows), -1).min(axis=1, initial=cut), cut)
    return clearance


def touches(field: GaussianCollisionField, hands: Hands, hand: HandShape, *, retreat: float) -> NDArray[np.bool_]:
    """Return whether fingers or palm, swept as boxes along an approach of ``retreat`` [m], may touch a Gaussian (K,).

    False is certain, True is conservative.
    """
    if not len(hands):
        return np.zeros(0, np.bool_)
    long = retreat + hand.palm + hand.tip
    middle = hand.tip - long / 2
    away = (hands.opening + hand.thickness) / 2
    boxes = [
        (np.c_[0 * away, sign * away, 0 * away + middle], (hand.width, hand.thickness, long)) for sign in (-1.0, 1.0)
    ]
    behind = np.tile([0.0, 0.0, -hand.palm - retreat / 2], (len(hands), 1))
    boxes.append((behind, (*hand.palm_size, retreat)))
    R, at = hands.T[:, :3, :3], hands.T[:, :3, 3]
    quats = rotation_to_quat(R)
    hit = np.zeros(len(hands), np.bool_)
    for centers, size in boxes:
        world = np.einsum("kij,kj->ki", R, centers) + at
        hit |= boxes_in_collision(
            field, world, quats, np.tile(size, (len(hands), 1)), tolerance=CONSTANTS.box_tolerance
        )
    return hit
