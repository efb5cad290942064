"""Causes of rejection: the joint, link and Gaussian that make a configuration or an edge invalid, and the depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.geometry import inverse, transform_points
from splatbot.planning.problem import Cause
from splatbot.protocols import Array, KinematicChain


@dataclass(frozen=True)
class CauseConstants:
    """Constants of the causes of infeasible starts and goals.

    Args:
        search_distance: [m] distance around the arm in which the obstacle is searched.
    """

    search_distance: float = 0.05


CONSTANTS = CauseConstants()


def limit_violation(chain: KinematicChain, q: Array) -> Cause | None:
    """Return the joint of ``q`` (J,) that exceeds its limits most, or None if all joints are within their limits."""
    beyond = chain.beyond_limits(q)
    return None if beyond is None else Cause(joint=beyond[0], depth=beyond[1], name=chain.names[beyond[0]])


def collision(arm: RobotSpheres, field: GaussianCollisionField, q: Array) -> Cause:
    """Return the deepest contact of ``q`` (J,) with the map or of the arm with itself; ``depth`` below 0 is clearance.

    The cause names no link and no Gaussian if the map is farther than ``SEARCH_DISTANCE``.
    """
    nearest = arm.clearance(field, q[None], cut=CONSTANTS.search_distance)
    clearance, pair = self_clearance(arm, q)
    if clearance < nearest.distance[0]:
        return Cause(int(pair[0]), int(pair[1]), -1, -clearance, name=_moves(arm, pair[0]))
    link, row = int(nearest.link[0]), int(nearest.index[0])
    if link < 0:
        return Cause()
    at_base, held = _deepest(arm, field, q, link)
    return Cause(link, -1, row, -float(nearest.distance[0]), name=_moves(arm, link), at_base=at_base, held=held)


def _moves(arm: RobotSpheres, link: int) -> str:
    """Return the name of the joint that moves a link, "" for the base."""
    return arm.robot.chain.names[link - 1] if link > 0 else ""


def _deepest(
    arm: RobotSpheres, field: GaussianCollisionField, q: Array, link: int
) -> tuple[tuple[float, float, float], bool]:
    """Return the centre of the link's sphere that is deepest in the map at ``q`` (J,), in the base frame [m].

    The second value is whether the sphere is of an object in the hand.
    """
    of = np.flatnonzero(arm.spheres.link == link)
    at = arm.centers(q[None])[0][of]
    k = int(np.argmin(field.clearance(at).distance - arm.spheres.radii[of]))
    x, y, z = transform_points(inverse(arm.T_world_base), at[k][None])[0]
    return (float(x), float(y), float(z)), bool(of[k] >= arm.own_count)


def self_clearance(arm: RobotSpheres, q: Array) -> tuple[float, tuple[int, int]]:
    """Return the smallest gap [m] between spheres of links that may not touch at ``q`` (J,), and the two links.

    The gap is infinite if every pair of links may touch.
    """
    at, radii, link = arm.centers(q[None])[0], arm.spheres.radii, arm.spheres.link
    apart = np.linalg.norm(at[:, None] - at[None], axis=-1) - radii[:, None] - radii[None]
    forbidden = np.zeros((link.max() + 1,) * 2, bool)
    forbidden[arm.pairs[:, 0], arm.pairs[:, 1]] = True
    apart[~forbidden[link[:, None], link[None]]] = np.inf
    a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return float(apart[a, b]), (int(link[a]), int(link[b]))


def blocked_line(arm: RobotSpheres, field: GaussianCollisionField, start: Array, goal: Array, eps: float) -> Cause:
    """Return the first collision found on the straight edge between two configurations (J,)."""
    edge = arm.certify(field, start[None], goal[None], eps=eps)
    if not edge.in_collision[0]:
        return Cause()
    return collision(arm, field, start + float(edge.at[0]) * (goal - start))
