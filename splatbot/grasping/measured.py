"""Check of grasps against the raw depth of the frames that see the place, apart from the map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatbot.collision.confirmed import confirmed_near
from splatbot.collision.visibility import DepthView, measured_depths
from splatbot.grasping.hands import Hands
from splatbot.protocols import Array, HandShape


@dataclass(frozen=True)
class MeasuredDepthConstants:
    """Constants of the check against measured depth.

    Args:
        max_penetration: [m] accepted depth of a confirmed point in fingers or palm.
        pad_penetration: [m] depth of a confirmed point in a closing finger at which it stops. It is smaller, because
            the frames that the search does not read confirm further points.
        contact_distance: [m] largest distance of a measured contact from the nearest confirmed point.
        unseen_from: [m] distance of a contact from depth above which its finger must be in space that was seen.
        max_unseen: largest unseen share of the inner face of such a finger.
        implied_gap: [m] free space that a pad needs at an implied contact, at the widest opening. Implied sides are
            wrong by millimetres, and a face that is seen to be free is known no better than depth.
        seen_sigmas: standard deviations of depth by which a ray must end behind a point to show that it is free.
        face_grid: points of a finger's inner face across and along its approach.
        spacing: [m] edge of the voxels in which each frame proposes one point.
        fine_spacing: [m] the same for the last check of one grasp.
        frames: largest number of raw depth images of a recording (150 MB).
        max_points: largest number of points that are confirmed; it bounds the work.
        hands_per_chunk: hands that are evaluated at once; it bounds memory.
    """

    max_penetration: float = 0.003
    pad_penetration: float = 0.002
    contact_distance: float = 0.003
    unseen_from: float = 0.006
    max_unseen: float = 0.1
    implied_gap: float = 0.006
    seen_sigmas: float = 3.0
    face_grid: tuple[int, int] = (7, 15)
    spacing: float = 0.003
    fine_spacing: float = 0.001
    frames: int = 120
    max_points: int = 60_000
    hands_per_chunk: int = 16


CONSTANTS = MeasuredDepthConstants()


_TIP = 0.002  # [m] of a finger's end that is not judged: depth noise hides the gap to a support


@dataclass(frozen=True, eq=False)
class RawDepth:
    """Raw depth images of a recording.

    Args:
        views: depth images without the filters of mapping, which remove thin objects.
        floor, quad: σ = ``floor`` + ``quad`` z² of their depth, in [m] and [1/m].
    """

    views: tuple[DepthView, ...]
    floor: float
    quad: float

    def around(self, points: Array, hand: HandShape) -> Array:
        """Return the confirmed surface points (S, 3) [m, world] within reach of a hand that grasps a target.

        A point is confirmed if two other frames measure it too.

        Args:
            points: (P, 3) points of the target [m, world].
            hand: shape of the hand.
        """
        reach = max(hand.stroke / 2 + hand.thickness, *hand.palm_size)
        return confirmed_near(
            self.views,
            points.min(axis=0) - reach,
            points.max(axis=0) + reach,
            floor=self.floor,
            quad=self.quad,
            spacing=CONSTANTS.spacing,
            most=CONSTANTS.max_points,
        )

    def along_approach(self, hands: Hands, hand: HandShape, retreat: float) -> Array:
        """Return the confirmed surface points (S, 3) [m, world] in one hand and on its approach, densely.

        The volume is that of :func:`hand_penetration`, with the space between the fingers and that of measured
        contacts. It is nearly empty for a hand that fits, so that all its pixels can be confirmed.

        Args:
            hands: one hand.
            hand: shape of the hand.
            retreat: length of the straight approach [m].
        """
        beyond = CONSTANTS.contact_distance
        x, y = hand.width / 2 + beyond, hands.opening[0] / 2 + hand.thickness + beyond
        rear, tip = -hand.palm - retreat, hand.tip + beyond
        sides = (max(x, hand.palm_size[0] / 2), max(y, hand.palm_size[1] / 2))

        def inside(points: Array) -> NDArray[np.bool_]:
            px, py, pz = np.abs(points[:, 0]), np.abs(points[:, 1]), points[:, 2]
            palm = (px < hand.palm_size[0] / 2) & (py < hand.palm_size[1] / 2) & (pz < -hand.palm)
            return np.asarray(palm | ((px < x) & (py < y)))

        return confirmed_near(
            self.views,
            np.array([-sides[0], -sides[1], rear]),
            np.array([*sides, tip]),
            floor=self.floor,
            quad=self.quad,
            spacing=CONSTANTS.fine_spacing,
            most=CONSTANTS.max_points,
            T_world_box=hands.T[0],
            inside=inside,
        )

    def unseen(self, hands: Hands, hand: HandShape) -> Array:
        """Return the share (K, 2) of the inner face of each finger, at -y and at +y, that no frame saw to be free.

        A frame shows that a point is free if its depth there is more than 3σ behind the point. The less of a face was
        seen, the more often the object continues into the finger (`splatbot bench grasping --one-sided`).

        Args:
            hands: K hands; the fingers are apart by their openings.
            hand: shape of the hand.
        """
        across, ahead = CONSTANTS.face_grid
        x, z = np.meshgrid(
            np.linspace(-hand.width / 2, hand.width / 2, across),
            np.linspace(-hand.palm, hand.tip - _TIP, ahead),
            indexing="ij",
        )
        y = hands.opening[:, None, None] / 2 * np.array([[-1.0], [1.0]]) * np.ones(x.size)
        local = np.stack([np.broadcast_to(x.ravel(), y.shape), y, np.broadcast_to(z.ravel(), y.shape)], axis=-1)
        points = np.einsum("kij,kspj->kspi", hands.T[:, :3, :3], local) + hands.T[:, None, None, :3, 3]
        flat, seen = points.reshape(-1, 3), np.zeros(points[..., 0].size, np.bool_)
        for depth, camera, T_world_camera in self.views:
            left = np.flatnonzero(~seen)
            rows, measured, own = measured_depths(flat[left], depth, camera, T_world_camera)
            free = measured - own > CONSTANTS.seen_sigmas * (self.floor + self.quad * own**2)
            seen[left[rows[free]]] = True
        return np.asarray(1.0 - seen.reshape(len(hands), 2, x.size).mean(axis=2))


def hand_penetration(hands: Hands, points: Array, hand: HandShape, *, retreat: float) -> Array:
    """Return the depth (K,) [m] of the deepest point in fingers or palm on an approach of ``retreat`` [m].

    The depth of a point in a box is its distance from the nearest face. The swept box of an approach has no rear face.
    The depth is 0 if no point is inside.

    Args:
        hands: K hands; the fingers are apart by their openings.
        points: (S, 3) measured points [m, world].
        hand: shape of the hand.
        retreat: length of the straight approach [m].
    """
    deepest = np.zeros(len(hands))
    for k, (x, y, z) in _local_points(hands, points):
        inner = hands.opening[k, None].astype(np.float32) / 2
        finger = np.minimum(hand.width / 2 - x, np.minimum(y - inner, inner + hand.thickness - y))
        finger = np.minimum(finger, hand.tip - z)
        palm = np.minimum(hand.palm_size[0] / 2 - x, hand.palm_size[1] / 2 - y)
        palm = np.minimum(palm, -hand.palm - z)
        inside = np.where(z > -hand.palm - retreat, np.maximum(finger, palm), 0.0)
        deepest[k] = np.maximum(inside.max(axis=1), 0.0)
    return deepest


def closed_width(hands: Hands, points: Array, hand: HandShape) -> Array:
    """Return the smallest width (K,) [m] between the fingers at which no point between them is deeper than 2 mm.

    The fingers close until they meet the object. Depth of a point in a finger is defined as in
    :func:`hand_penetration`. The width is 0 if no point is between the fingers.

    Args:
        hands: K hands with their openings.
        points: (S, 3) measured points [m, world].
        hand: shape of the hand.
    """
    width, deep = np.zeros(len(hands)), CONSTANTS.pad_penetration
    for k, (x, y, z) in _local_points(hands, points):
        inner = hands.opening[k, None].astype(np.float32) / 2
        between = (x < hand.width / 2 - deep) & (y < inner) & (z < hand.tip - deep) & (z > -hand.palm)
        width[k] = 2 * np.maximum(np.where(between, y, 0.0).max(axis=1) - deep, 0.0)
    return width


def _local_points(hands: Hands, points: Array) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Yield |x|, |y| and z (3, K', S) [m] of points in the frames of some hands at a time, with their slice."""
    near = points.astype(np.float32)
    for first in range(0, len(hands) if len(points) else 0, CONSTANTS.hands_per_chunk):
        k = slice(first, first + CONSTANTS.hands_per_chunk)
        R, at = hands.T[k, :3, :3].astype(np.float32), hands.T[k, :3, 3].astype(np.float32)
        x, y, z = (R.swapaxes(1, 2) @ near.T - np.einsum("kji,kj->ki", R, at)[:, :, None]).swapaxes(0, 1)
        yield k, np.stack([np.abs(x), np.abs(y), z])


def contact_distances(contacts: Array, points: Array) -> Array:
    """Return the distance (..., ) [m] of contacts (..., 3) from the nearest of the points (S, 3), inf without any."""
    if not len(points):
        return np.full(contacts.shape[:-1], np.inf)
    return np.asarray(cKDTree(points).query(contacts)[0])


def blind(depth_distance: Array, unseen: Array) -> NDArray[np.bool_]:
    """Return which fingers (..., ) enter unseen space, by the distance of their contacts from depth [m]."""
    return (depth_distance > CONSTANTS.unseen_from) & (unseen > CONSTANTS.max_unseen)
