"""Collision of capsules, swept spheres and oriented boxes: adaptive covers of spheres against the field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.inputs import as_float64, radii, rows
from splatbot.errors import InputError
from splatbot.geometry import quat_to_rotation
from splatbot.protocols import Array


@dataclass(frozen=True)
class BodyConstants:
    """Constants of collision tests between bodies and ellipsoids.

    Args:
        contact_tolerance: [m] a body nearer to an ellipsoid than this may be reported as a collision.
        chunk: cells in one query; it bounds memory.
    """

    contact_tolerance: float = 2e-4
    chunk: int = 200_000


CONSTANTS = BodyConstants()


# Splits cells, given as centres (C, 3), sizes as fractions of the body (C,), and body indices (C,).
_Split = Callable[[Array, Array, NDArray[np.int64]], tuple[Array, Array, NDArray[np.int64]]]


def capsules_in_collision(
    field: GaussianCollisionField,
    start: ArrayLike | Tensor,
    end: ArrayLike | Tensor,
    radius: ArrayLike | Tensor,
    *,
    tolerance: float = CONSTANTS.contact_tolerance,
) -> NDArray[np.bool_]:
    """Check whether capsules, which are spheres swept along segments, may collide with a Gaussian (P,).

    A part of a capsule is free if the sphere around its middle that encloses it is free. It collides if the sphere of
    the capsule's radius there collides. Otherwise it is bisected. False is certain; true may be wrong for a capsule
    whose clearance is below the tolerance.

    Args:
        field: collision field.
        start, end: (P, 3) ends of the segments [m, world].
        radius: (P,) or one for all [m].
        tolerance: size of a part that is not bisected further [m].

    Raises:
        InputError: shapes do not fit, or a value is not finite or negative.
    """
    a, b = rows(start, "start", 3, "world coordinates in metres"), rows(end, "end", 3, "world coordinates in metres")
    if len(a) != len(b):
        raise InputError(f"has {len(b)} rows for {len(a)} of start.", field="end", hint="give one end for each")
    own = radii(np.broadcast_to(as_float64(radius), (len(a),)).astype(np.float64)).astype(np.float64)
    half = (b - a) / 2

    def split(centers: Array, sizes: Array, body: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.int64]]:
        offset = half[body] * sizes[:, None] / 2
        return np.concatenate([centers - offset, centers + offset]), np.tile(sizes / 2, 2), np.tile(body, 2)

    reach = np.linalg.norm(half, axis=1)
    return _search(field, (a + b) / 2, own, reach, split, _checked(tolerance))


def boxes_in_collision(
    field: GaussianCollisionField,
    centers: ArrayLike | Tensor,
    quats: ArrayLike | Tensor,
    sizes: ArrayLike | Tensor,
    *,
    tolerance: float = 1e-3,
) -> NDArray[np.bool_]:
    """Check whether oriented boxes may collide with a Gaussian (P,).

    The search is that of :func:`capsules_in_collision`, with cells that split into eight.

    Args:
        field: collision field.
        centers: (P, 3) [m, world].
        quats: (P, 4) wxyz.
        sizes: (P, 3) edge lengths [m].
        tolerance: size of a cell that is not split further [m]. A box that lies along a surface costs
            (size / tolerance)² queries.

    Raises:
        InputError: shapes do not fit, or a value is not finite or negative, or a quaternion is zero.
    """
    c, s = rows(centers, "centers", 3, "world coordinates in metres"), rows(sizes, "sizes", 3, "metres")
    q = rows(quats, "quats", 4, "quaternions wxyz")
    if not len(c) == len(s) == len(q):
        raise InputError("centers, quats and sizes differ in length.", field="boxes", hint="give one of each for a box")
    if (s < 0).any() or not q.any(axis=1).all():
        raise InputError("a size is negative or a quaternion zero.", field="boxes", hint="give metres and rotations")
    half = quat_to_rotation(q) * (s / 2)[:, None, :] if len(q) else np.zeros((0, 3, 3))
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)

    def split(at: Array, part: Array, body: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.int64]]:
        offsets = np.einsum("cij,ej->cei", half[body] * part[:, None, None] / 2, corners)
        return (at[:, None] + offsets).reshape(-1, 3), np.repeat(part / 2, 8), np.repeat(body, 8)

    reach = np.linalg.norm(s / 2, axis=1)
    return _search(field, c, np.zeros(len(c)), reach, split, _checked(tolerance))


def _search(
    field: GaussianCollisionField, centers: Array, own: Array, reach: Array, split: _Split, tolerance: float
) -> NDArray[np.bool_]:
    """Run branch and bound over the cells of all bodies at once.

    Args:
        field: collision field.
        centers: (P, 3) centres of the bodies [m, world].
        own: (P,) radii of their spheres [m].
        reach: (P,) distance from the centre by which the body exceeds that sphere [m].
        split: splits cells.
        tolerance: see :func:`capsules_in_collision` [m].
    """
    hit = np.zeros(len(centers), np.bool_)
    at, part, body = centers, np.ones(len(centers)), np.arange(len(centers))
    while len(at):
        left: list[tuple[Array, Array, NDArray[np.int64]]] = []
        for k in range(0, len(at), CONSTANTS.chunk):
            c, p, b = at[k : k + CONSTANTS.chunk], part[k : k + CONSTANTS.chunk], body[k : k + CONSTANTS.chunk]
            c, p, b = c[~hit[b]], p[~hit[b]], b[~hit[b]]
            extent = reach[b] * p
            doubtful = field.in_collision(np.c_[c, own[b] + extent])
            c, p, b, extent = c[doubtful], p[doubtful], b[doubtful], extent[doubtful]
            sure = (extent <= tolerance) | field.in_collision(np.c_[c, own[b]]) if len(c) else np.zeros(0, np.bool_)
            hit[b[sure]] = True
            c, p, b = c[~sure], p[~sure], b[~sure]
            left.append(split(c, p, b))
        at, part, body = (np.concatenate([x[i] for x in left]) for i in range(3))
        open_ = ~hit[body]
        at, part, body = at[open_], part[open_], body[open_]
    return hit


def _checked(tolerance: float) -> float:
    if not 1e-6 <= tolerance < np.inf:
        raise InputError(f"is {tolerance}.", field="tolerance", hint="give metres, at least 0.000001")
    return tolerance
