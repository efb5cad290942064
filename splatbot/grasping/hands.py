"""Poses of the hand for pairs of contacts, and the room that it has beside the target."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.antipodal import Pairs
from splatbot.grasping.surface import GraspSurface
from splatbot.protocols import Array, HandShape

FLUSH = 0.006  # [m] that anything under the pads may stand out beyond the contact
SLACK = 0.003  # [m] between each pad and the target as the hand comes
OPENINGS = 0.002  # [m] that openings are rounded up to
_CHUNK, _SAMPLE = 32, 250  # hands at once; points for a first look
_GIVE = 0.003  # [m] that implied sides are off by and do not stop a hand
_TOUCH = 0.003  # [m] between a pad and what it presses
_SINK = 0.001  # [m] that a pad gives way where it touches
_END = 0.002  # [m] from the end of flat pads where a contact may be at most
_LOOK = 0.03  # [m] of room beyond which more is no better


@dataclass(frozen=True, eq=False)
class Hands:
    """K poses of the hand.

    Args:
        T: (K, 4, 4) T_world_tcp.
        pair: (K,) which pair of contacts it presses.
        opening: (K,) of the fingers as they come [m].
        room: (K,) to the target, beside the pads and behind, on the straight way to the grasp [m]; below 0: it is hit.
        stands_out: (K,) how far the target stands out beyond the contacts under the pads [m].
        held: (K,) share of the pads' flat ends that has something under it, 0..1.
        closure: (K,) as of pairs, of where the pads touch as they close: what was planned as contacts may be beside it.
    """

    T: Array
    pair: NDArray[np.int64]
    opening: Array
    room: Array
    stands_out: Array
    held: Array
    closure: Array

    def __len__(self) -> int:
        return len(self.T)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Hands:
        """Those that are named."""
        return Hands(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def place_hands(pairs: Pairs, hand: HandShape, *, rolls: int, depths: int, up: Array, lowest: float) -> Hands:
    """Every pair, from ``rolls`` sides around the line between its contacts, at ``depths`` depths.

    Args:
        pairs: of contacts.
        hand: the fingers.
        rolls: directions around the closing axis.
        depths: how far the contacts are from the tips: from near the tips to near the palm.
        up: (3,) unit, in the world.
        lowest: the least cosine between the approach and the way down that is tried.
    """
    y = pairs.contacts[:, 1] - pairs.contacts[:, 0]
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    down = -up - np.einsum("i,ci->c", -up, y)[:, None] * y  # the most downward approach
    level = np.linalg.norm(down, axis=1) < 1e-3
    down[level] = np.cross(y[level], np.eye(3)[np.abs(y[level]).argmin(axis=1)])
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    across = np.cross(y, down)
    turns = np.linspace(0.0, 2 * np.pi, rolls, endpoint=False)
    z = np.cos(turns)[None, :, None] * down[:, None] + np.sin(turns)[None, :, None] * across[:, None]
    front, back = min((hand.tip + hand.pad) / 2, hand.tip - _END), -0.6 * hand.palm
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
    opening = np.minimum(np.ceil((pairs.width[pair] + 2 * SLACK) / OPENINGS) * OPENINGS, hand.stroke)
    return Hands(poses, pair, opening, *(zero.copy() for _ in range(4)))


def clear_palm(hands: Hands, surface: GraspSurface, hand: HandShape, *, retreat: float) -> NDArray[np.bool_]:
    """Whether the palm has nothing of a sample of the target before it (K,): quick, to be followed by more."""
    step = max(1, len(surface) // _SAMPLE)
    p = (surface.points[::step] - surface.center).astype(np.float32)
    free = np.ones(len(hands), np.bool_)
    for k in range(0, len(hands), 32 * _CHUNK):
        T = hands.T[k : k + 32 * _CHUNK]
        axes, at = T[:, :3, :3].astype(np.float32), (T[:, :3, 3] - surface.center).astype(np.float32)
        x, y, z = (axes[:, :, i] @ p.T - np.einsum("ij,ij->i", axes[:, :, i], at)[:, None] for i in range(3))
        across = (np.abs(x) < hand.palm_size[0] / 2) & (np.abs(y) < hand.palm_size[1] / 2)
        free[k : k + 32 * _CHUNK] = ~(across & (z < -hand.palm) & (z > -hand.palm - retreat)).any(axis=1)
    return free


def beside_target(
    hands: Hands,
    pairs: Pairs,
    surface: GraspSurface,
    hand: HandShape,
    *,
    retreat: float,
    n_sigma: float,
    friction: float,
) -> Hands:
    """The hands with their opening, their room to the target on a straight way of ``retreat`` [m], and what they hold.

    Each Gaussian is the box around its ellipsoid along the hand's axes, which is no smaller. Under the pads it asks for
    a wider opening; beside a finger, behind its tip, or where the palm is, it is in the way.
    """
    center = surface.center
    p = (surface.points - center).astype(np.float32)
    axes = [np.ascontiguousarray((n_sigma * surface.half[:, :, i]).astype(np.float32).T) for i in range(3)]
    give = np.where(surface.seen, 0.0, _GIVE).astype(np.float32)
    out = [np.empty(len(hands)) for _ in range(5)]
    half = (pairs.width[hands.pair] / 2).astype(np.float32)
    for k in range(0, len(hands), _CHUNK):
        T = hands.T[k : k + _CHUNK]
        R, at = T[:, :3, :3].astype(np.float32), (T[:, :3, 3] - center).astype(np.float32)
        local, reach = [], []
        for i in range(3):
            u = np.ascontiguousarray(R[:, :, i])
            local.append(u @ p.T - np.einsum("ij,ij->i", u, at)[:, None])
            reach.append(np.sqrt(sum((u @ axis) ** 2 for axis in axes)) - give)
        found = _measured(local, reach, half[k : k + _CHUNK, None], hand, retreat)
        for into, values in zip(out, (*found, _closure(local, give, hand, np.arctan(friction))), strict=True):
            into[k : k + _CHUNK] = values
    opening, room, stands_out, held, closure = out
    return replace(hands, opening=opening, room=room, stands_out=stands_out, held=held, closure=closure)


def _measured(
    local: list[NDArray[np.float32]],
    reach: list[NDArray[np.float32]],
    half: NDArray[np.float32],
    hand: HandShape,
    retreat: float,
) -> tuple[Array, Array, Array, Array]:
    """Opening, room, what stands out and what is held, (K,) each, of K hands and M Gaussians (K, M)."""
    x, y, z = local
    side = np.abs(y)
    dx = np.abs(x) - reach[0] - hand.width / 2  # gap to the fingers across
    dz = z - reach[2] - hand.tip  # gap ahead of the tips
    under = (np.abs(x) < hand.width / 2) & (z < hand.tip) & (z > -hand.palm)
    stands_out = np.where(under & (side < half + 0.02), side - half, -np.inf).max(axis=1)
    solid = np.where(under & (side < half + FLUSH), side + np.minimum(reach[1], FLUSH), half).max(axis=1)
    opening = 2 * (np.maximum(solid, half[:, 0]) + SLACK)
    opening = np.minimum(np.ceil(opening.astype(np.float64) / OPENINGS) * OPENINGS, hand.stroke)
    inner = opening[:, None] / 2
    dy = np.maximum(inner - (side + reach[1]), (side - reach[1]) - inner - hand.thickness)
    finger = np.maximum(np.maximum(dx, dz), np.maximum(dy, -hand.palm - retreat - z - reach[2]))
    palm = np.maximum(
        np.maximum(np.abs(x) - reach[0] - hand.palm_size[0] / 2, side - reach[1] - hand.palm_size[1] / 2),
        np.maximum(z - reach[2] + hand.palm, -hand.palm - retreat - z - reach[2]),
    )
    room = np.minimum(np.minimum(finger, palm).min(axis=1), _LOOK)
    held = _held(x, y, z, half, hand)
    return opening, room, stands_out, held


def _held(
    x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32], half: NDArray[np.float32], hand: HandShape
) -> Array:
    """Of four by four parts of the flat end of each pad, the share that has the surface under it, of the lesser pad."""
    column = np.floor((x / hand.width + 0.5) * 4)
    line = np.floor((z - hand.pad) / hand.width * 4) + 4
    on = (column >= 0) & (column < 4) & (line >= 0) & (line < 4)
    part = np.left_shift(1, np.where(on, 4 * column + line, 0).astype(np.int32))
    found = []
    for sign in (-1.0, 1.0):
        touched = on & (np.abs(sign * y - half) < _TOUCH)
        bits = np.bitwise_or.reduce(np.where(touched, part, 0), axis=1)
        found.append(np.unpackbits(bits.astype(np.uint16)[:, None].view(np.uint8), axis=1).sum(axis=1) / 16)
    return np.minimum(*found)


def _closure(local: list[NDArray[np.float32]], give: NDArray[np.float32], hand: HandShape, cone: float) -> Array:
    """How far inside of the friction cone the line between the places is where the pads touch first (K,).

    Flat pads meet what stands out most under them, wherever a grasp was meant to be; a round finger meets it with a
    face that is turned, which pushes it out.
    """
    x, y, z = local
    side, side_back = _rounded(np.abs(x) - hand.pad_width / 2, (hand.width - hand.pad_width) / 2)
    end, end_back = _rounded(z - hand.pad, hand.tip - hand.pad)
    side *= np.sign(x)
    under = (np.abs(x) < hand.width / 2) & (z < hand.tip) & (z > -hand.palm)
    places, turned = [], []
    for sign in (-1.0, 1.0):
        height = np.where(under & (sign * y > 0.0), sign * y - side_back - end_back - give, -np.inf)
        top = height.max(axis=1, keepdims=True)
        weight = np.exp((height - np.where(np.isfinite(top), top, 0.0)) / _SINK)
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
        places.append(np.stack([np.einsum("km,km->k", weight, values) for values in local], axis=1))
        turned.append(np.stack([np.einsum("km,km->k", weight, values) for values in (side, end)], axis=1))
    line = places[1] - places[0]
    line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-12)
    cosines = []
    for sign, sines in zip((-1.0, 1.0), turned, strict=True):
        facing = np.sqrt(np.maximum(1.0 - (sines**2).sum(axis=1), 0.0))
        cosines.append(line[:, 1] * facing - sign * (line[:, [0, 2]] * sines).sum(axis=1))
    return np.asarray(1.0 - np.arccos(np.clip(np.minimum(*cosines), -1.0, 1.0)) / cone)


def _rounded(beyond: Array | NDArray[np.float32], radius: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of a face so far ``beyond`` its flat part, rounded off with a radius [m]: sine of its turn, and its set-back."""
    sine = np.clip(beyond / max(radius, 1e-6), 0.0, 0.999).astype(np.float32)
    return sine, (max(radius, 0.0) * (1.0 - np.sqrt(1.0 - sine**2))).astype(np.float32)
