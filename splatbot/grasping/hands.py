"""Hand poses for contact pairs, and the collision of fingers and palm with the target."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.antipodal import Pairs
from splatbot.grasping.surface import GraspSurface
from splatbot.protocols import Array, HandShape


@dataclass(frozen=True)
class HandPoseConstants:
    """Constants of hand placement and of the collision tests against the target."""

    hands_per_chunk: int = 32
    """Number of hands [1] that are evaluated at once. It bounds memory and has no effect on the result."""
    quick_points: int = 250
    """Number of surface points [1] of the quick test of the palm. Fewer of them pass more hands to the exact test."""
    completion_tolerance: float = 0.003
    """Error [m] of completed points, by which they are shrunk. A larger one accepts grasps closer to an unobserved
    side."""
    contact_tolerance: float = 0.003
    """Largest distance [m] between a pad and a surface point in contact. A larger one reports more of the pad as
    covered."""
    pad_compliance: float = 0.001
    """Depth [m] over which the soft pad distributes its contact. A smaller one concentrates it on the highest point."""
    tip_margin: float = 0.002
    """Smallest distance [m] of a contact from the finger tips. A larger one moves hands closer to the object."""
    max_protrusion: float = 0.006
    """Largest height [m] of the target under a pad above the planned contact. A larger one opens the hand
    wider."""
    pad_gap: float = 0.003
    """Distance [m] between each pad and the target during the approach. A larger one needs a wider opening."""
    min_pad_gap: float = 0.002
    """Smallest such distance [m], at the widest opening. It covers errors of the map and the arm; a smaller one offers
    objects that the hand may not clear."""
    opening_step: float = 0.002
    """Step [m] to whose multiples finger openings are rounded up. A larger one opens the hand wider than the target
    needs."""
    max_clearance: float = 0.03
    """Clearance [m] above which larger values are clipped, since they do not make a grasp better."""


CONSTANTS = HandPoseConstants()


def usable_opening(stroke: float) -> float:
    """Return the largest width [m] that a hand of this ``stroke`` [m] encloses with a gap at each pad."""
    return max(stroke - 2 * CONSTANTS.min_pad_gap, 0.0)


@dataclass(frozen=True, eq=False)
class Hands:
    """K poses of the hand.

    Args:
        T: (K, 4, 4) T_world_tcp.
        pair: (K,) index of the contact pair.
        opening: (K,) finger opening during the approach [m].
        clearance: (K,) signed distance of fingers and palm to the target along the straight approach [m]; negative in
            collision. The volume between the pads does not count.
        protrusion: (K,) height of the target under the pads beyond the planned contacts [m].
        pad_coverage: (K,) fraction of the flat pad ends in contact with the target, 0..1, minimum of both pads.
        closure: (K,) force-closure margin as in :class:`splatbot.grasping.antipodal.Pairs`, at the points that the pads
            touch first. They may differ from the planned contacts.
    """

    T: Array
    pair: NDArray[np.int64]
    opening: Array
    clearance: Array
    protrusion: Array
    pad_coverage: Array
    closure: Array

    @classmethod
    def one(cls, T: Array, opening: float) -> Hands:
        """Return a single hand at a pose (4, 4) that belongs to no pair; nothing of it is measured."""
        zero = np.zeros(1)
        return cls(T[None], np.zeros(1, np.int64), np.array([opening]), zero, zero, zero, zero)

    def __len__(self) -> int:
        return len(self.T)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Hands:
        """Return the chosen hands."""
        return Hands(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def place_hands(pairs: Pairs, hand: HandShape, *, rolls: int, depths: int, up: Array, lowest: float) -> Hands:
    """Place hands on every pair, with ``rolls`` approach directions around the closing axis and ``depths`` depths.

    Args:
        pairs: contact pairs.
        hand: shape of the hand.
        rolls: number of approach directions around the line of the contacts.
        depths: number of distances between contacts and finger tips, from near the tips to near the palm.
        up: (3,) unit up axis [world].
        lowest: minimum cosine between the approach direction and down.
    """
    y = pairs.contacts[:, 1] - pairs.contacts[:, 0]
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    down = -up - np.einsum("i,ci->c", -up, y)[:, None] * y  # steepest approach that is normal to y
    level = np.linalg.norm(down, axis=1) < 1e-3
    down[level] = np.cross(y[level], np.eye(3)[np.abs(y[level]).argmin(axis=1)])
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    across = np.cross(y, down)
    turns = np.linspace(0.0, 2 * np.pi, rolls, endpoint=False)
    z = np.cos(turns)[None, :, None] * down[:, None] + np.sin(turns)[None, :, None] * across[:, None]
    front, back = min((hand.tip + hand.pad) / 2, hand.tip - CONSTANTS.tip_margin), -0.6 * hand.palm
    places = np.linspace(front, back, depths)
    shape = (len(pairs), rolls, depths)
    T = np.zeros((*shape, 4, 4))
    T[..., 3, 3] = 1.0
    yy, zz = np.broadcast_to(y[:, None, None], (*shape, 3)), np.broadcast_to(z[:, :, None], (*shape, 3))
    T[..., :3, 0], T[..., :3, 1], T[..., :3, 2] = np.cross(yy, zz), yy, zz
    T[..., :3, 3] = pairs.contacts.mean(axis=1)[:, None, None] - zz * places[None, None, :, None]
    pair = np.broadcast_to(np.arange(len(pairs))[:, None, None], shape).ravel()
    poses = T.reshape(-1, 4, 4)
    steep = -(poses[:, :3, 2] @ up) >= lowest
    poses, pair = poses[steep], pair[steep]
    zero = np.zeros(len(poses))
    opening = np.minimum(
        np.ceil((pairs.width[pair] + 2 * CONSTANTS.pad_gap) / CONSTANTS.opening_step) * CONSTANTS.opening_step,
        hand.stroke,
    )
    return Hands(poses, pair, opening, *(zero.copy() for _ in range(4)))


def palm_free(hands: Hands, surface: GraspSurface, hand: HandShape, *, retreat: float) -> NDArray[np.bool_]:
    """Return whether the swept palm is free of a subsample of the target (K,).

    This quick test rejects most hands before :func:`measure_hands`.
    """
    step = max(1, len(surface) // CONSTANTS.quick_points)
    p = (surface.points[::step] - surface.center).astype(np.float32)
    free = np.ones(len(hands), np.bool_)
    for k in range(0, len(hands), 32 * CONSTANTS.hands_per_chunk):
        T = hands.T[k : k + 32 * CONSTANTS.hands_per_chunk]
        axes, at = T[:, :3, :3].astype(np.float32), (T[:, :3, 3] - surface.center).astype(np.float32)
        x, y, z = (axes[:, :, i] @ p.T - np.einsum("ij,ij->i", axes[:, :, i], at)[:, None] for i in range(3))
        across = (np.abs(x) < hand.palm_size[0] / 2) & (np.abs(y) < hand.palm_size[1] / 2)
        free[k : k + 32 * CONSTANTS.hands_per_chunk] = ~(across & (z < -hand.palm) & (z > -hand.palm - retreat)).any(
            axis=1
        )
    return free


def measure_hands(
    hands: Hands,
    pairs: Pairs,
    surface: GraspSurface,
    hand: HandShape,
    *,
    retreat: float,
    n_sigma: float,
    friction: float,
) -> Hands:
    """Compute opening, clearance, protrusion, pad coverage and closure of hands on an approach of ``retreat`` [m].

    Each Gaussian is represented by the bounding box of its ellipsoid along the hand's axes, which is conservative.
    Gaussians between the pads increase the opening; all others are obstacles for the fingers and the palm.

    Args:
        hands: poses of the hand.
        pairs: contact pairs of the poses.
        surface: surface of the target.
        hand: shape of the hand.
        retreat: length of the straight approach [m].
        n_sigma: size of the ellipsoids in standard deviations.
        friction: friction coefficient mu.
    """
    center = surface.center
    p = (surface.points - center).astype(np.float32)
    axes = [np.ascontiguousarray((n_sigma * surface.axes[:, :, i]).astype(np.float32).T) for i in range(3)]
    tolerance = np.where(surface.observed, 0.0, CONSTANTS.completion_tolerance).astype(np.float32)
    out = [np.empty(len(hands)) for _ in range(5)]
    half = (pairs.width[hands.pair] / 2).astype(np.float32)
    for k in range(0, len(hands), CONSTANTS.hands_per_chunk):
        T = hands.T[k : k + CONSTANTS.hands_per_chunk]
        R, at = T[:, :3, :3].astype(np.float32), (T[:, :3, 3] - center).astype(np.float32)
        local, reach = [], []
        for i in range(3):
            u = np.ascontiguousarray(R[:, :, i])
            local.append(u @ p.T - np.einsum("ij,ij->i", u, at)[:, None])
            reach.append(np.sqrt(sum((u @ axis) ** 2 for axis in axes)) - tolerance)
        found = _measured(local, reach, half[k : k + CONSTANTS.hands_per_chunk, None], hand, retreat)
        for into, values in zip(out, (*found, _closure(local, tolerance, hand, np.arctan(friction))), strict=True):
            into[k : k + CONSTANTS.hands_per_chunk] = values
    opening, clearance, protrusion, coverage, closure = out
    return replace(
        hands, opening=opening, clearance=clearance, protrusion=protrusion, pad_coverage=coverage, closure=closure
    )


def _measured(
    local: list[NDArray[np.float32]],
    reach: list[NDArray[np.float32]],
    half: NDArray[np.float32],
    hand: HandShape,
    retreat: float,
) -> tuple[Array, Array, Array, Array]:
    """Return opening, clearance, protrusion and pad coverage, (K,) each, from points in the hands' frames (K, M)."""
    x, y, z = local
    side = np.abs(y)
    dx = np.abs(x) - reach[0] - hand.width / 2  # gap to the fingers along x
    dz = z - reach[2] - hand.tip  # gap to the tips along z
    under = (np.abs(x) < hand.width / 2) & (z < hand.tip) & (z > -hand.palm)
    protrusion = np.where(under & (side < half + 0.02), side - half, -np.inf).max(axis=1)
    solid = np.where(
        under & (side < half + CONSTANTS.max_protrusion), side + np.minimum(reach[1], CONSTANTS.max_protrusion), half
    ).max(axis=1)
    opening = 2 * (np.maximum(solid, half[:, 0]) + CONSTANTS.pad_gap)
    opening = np.minimum(
        np.ceil(opening.astype(np.float64) / CONSTANTS.opening_step) * CONSTANTS.opening_step, hand.stroke
    )
    inner = opening[:, None] / 2
    dy = np.maximum(inner - (side + reach[1]), (side - reach[1]) - inner - hand.thickness)
    finger = np.maximum(np.maximum(dx, dz), np.maximum(dy, -hand.palm - retreat - z - reach[2]))
    palm = np.maximum(
        np.maximum(np.abs(x) - reach[0] - hand.palm_size[0] / 2, side - reach[1] - hand.palm_size[1] / 2),
        np.maximum(z - reach[2] + hand.palm, -hand.palm - retreat - z - reach[2]),
    )
    clearance = np.minimum(np.minimum(finger, palm).min(axis=1), CONSTANTS.max_clearance)
    return opening, clearance, protrusion, _pad_coverage(x, y, z, half, hand)


def _pad_coverage(
    x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32], half: NDArray[np.float32], hand: HandShape
) -> Array:
    """Return the fraction of the 4 x 4 cells of a flat pad end that touch the surface (K,), minimum of both pads."""
    column = np.floor((x / hand.width + 0.5) * 4)
    line = np.floor((z - hand.pad) / hand.width * 4) + 4
    on = (column >= 0) & (column < 4) & (line >= 0) & (line < 4)
    part = np.left_shift(1, np.where(on, 4 * column + line, 0).astype(np.int32))
    found = []
    for sign in (-1.0, 1.0):
        contact = on & (np.abs(sign * y - half) < CONSTANTS.contact_tolerance)
        bits = np.bitwise_or.reduce(np.where(contact, part, 0), axis=1)
        found.append(np.unpackbits(bits.astype(np.uint16)[:, None].view(np.uint8), axis=1).sum(axis=1) / 16)
    return np.minimum(*found)


def _closure(local: list[NDArray[np.float32]], tolerance: NDArray[np.float32], hand: HandShape, cone: float) -> Array:
    """Return the force-closure margin of the points that the pads touch first (K,).

    A pad first touches the highest surface points under it, which may differ from the planned contacts. Each contact is
    the mean of the points under the pad with the weights exp(height / compliance). The contact normal is that of the
    pad: on a rounded finger end it is inclined and pushes the object out.
    """
    x, y, z = local
    side, side_back = _rounded(np.abs(x) - hand.pad_width / 2, (hand.width - hand.pad_width) / 2)
    end, end_back = _rounded(z - hand.pad, hand.tip - hand.pad)
    side *= np.sign(x)
    under = (np.abs(x) < hand.width / 2) & (z < hand.tip) & (z > -hand.palm)
    contacts, inclined = [], []
    for sign in (-1.0, 1.0):
        height = np.where(under & (sign * y > 0.0), sign * y - side_back - end_back - tolerance, -np.inf)
        top = height.max(axis=1, keepdims=True)
        weight = np.exp((height - np.where(np.isfinite(top), top, 0.0)) / CONSTANTS.pad_compliance)
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
        contacts.append(np.stack([np.einsum("km,km->k", weight, values) for values in local], axis=1))
        inclined.append(np.stack([np.einsum("km,km->k", weight, values) for values in (side, end)], axis=1))
    line = contacts[1] - contacts[0]
    line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-12)
    cosines = []
    for sign, sines in zip((-1.0, 1.0), inclined, strict=True):
        facing = np.sqrt(np.maximum(1.0 - (sines**2).sum(axis=1), 0.0))
        cosines.append(line[:, 1] * facing - sign * (line[:, [0, 2]] * sines).sum(axis=1))
    return np.asarray(1.0 - np.arccos(np.clip(np.minimum(*cosines), -1.0, 1.0)) / cone)


def _rounded(beyond: Array | NDArray[np.float32], radius: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the sine of the inclination and the set-back [m] of a rounded edge, ``beyond`` [m] the flat part.

    On an edge of radius r at the distance b from the flat part: sin(a) = b / r, set-back = r (1 - cos(a)).
    """
    sine = np.clip(beyond / max(radius, 1e-6), 0.0, 0.999).astype(np.float32)
    return sine, (max(radius, 0.0) * (1.0 - np.sqrt(1.0 - sine**2))).astype(np.float32)
