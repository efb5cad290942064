"""The hand on its straight way, against fields of Gaussians."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, boxes_in_collision
from splatbot.geometry import inverse, rotation_to_quat, transform_points
from splatbot.grasping.hands import Hands
from splatbot.protocols import Array, HandShape, HasHand, RobotKinematics

LOOK = 0.03  # [m] of room beyond which nothing is looked for
_PLACES = 5  # on the way
_AT_ONCE = 4096  # hands
_TOLERANCE = 1e-3  # [m]


def swept_room(robot: RobotKinematics, hands: Hands, field: GaussianCollisionField, *, retreat: float) -> Array:
    """Of the spheres of the robot's last link, at five places of a way of ``retreat`` [m] (K,) [m], at most 3 cm.

    The certificate that nothing is touched between those places is the arm's own, see
    :func:`splatbot.planning.cartesian.straight_line`.
    """
    return _room(robot, hands, field, back=np.linspace(0.0, retreat, _PLACES), cut=LOOK)


def fingers_room(robot: RobotKinematics, hands: Hands, field: GaussianCollisionField, hand: HandShape) -> Array:
    """Of the spheres before the palm alone, where the hand takes hold (K,) [m], at most 1 mm: quick, for many hands."""
    return _room(robot, hands, field, back=np.zeros(1), cut=_TOLERANCE, ahead=-hand.palm)


def _room(
    robot: RobotKinematics,
    hands: Hands,
    field: GaussianCollisionField,
    *,
    back: Array,
    cut: float,
    ahead: float = -np.inf,
) -> Array:
    """(K,) [m], at most ``cut``, at places ``back`` (B,) [m] behind the grasp, of spheres ``ahead`` of a plane [m]."""
    assert isinstance(robot, HasHand)
    T_tcp_link = inverse(robot.T_link_tcp)
    room = np.full(len(hands), cut)
    alike = (np.flatnonzero(hands.opening == opening) for opening in np.unique(hands.opening))
    for rows in (some[k : k + _AT_ONCE] for some in alike for k in range(0, len(some), _AT_ONCE)):
        spheres = robot.spheres(float(hands.opening[rows[0]]))
        own = spheres.link == len(robot.chain)
        local, radii = transform_points(T_tcp_link, spheres.centers[own]), spheres.radii[own]
        local, radii = local[local[:, 2] > ahead], radii[local[:, 2] > ahead]
        places = (local[None] - back[:, None, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)
        T = hands.T[rows]
        centers = np.einsum("kij,sj->ksi", T[:, :3, :3], places) + T[:, None, :3, 3]
        wide = np.broadcast_to(np.tile(radii, len(back)), centers.shape[:2])
        away = field.clearance(np.c_[centers.reshape(-1, 3), wide.reshape(-1)], cut=cut).distance
        room[rows] = np.minimum(away.reshape(len(rows), -1).min(axis=1, initial=cut), cut)
    return room


def touches(field: GaussianCollisionField, hands: Hands, hand: HandShape, *, retreat: float) -> NDArray[np.bool_]:
    """Whether fingers or palm, as boxes along a way of ``retreat`` [m], may touch a Gaussian (K,); false is certain."""
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
        hit |= boxes_in_collision(field, world, quats, np.tile(size, (len(hands), 1)), tolerance=_TOLERANCE)
    return hit
