"""Why a configuration or an edge will not do: which joint, which link, which Gaussian, how deep."""

from __future__ import annotations

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.planning.problem import Cause
from splatbot.protocols import Array, KinematicChain

LOOK = 0.05  # [m] around the arm, for what is in the way
LIMIT_SLACK = 1e-6  # [rad or m] that a start or goal may be beyond a limit, as encoders at a stop read


def beyond_limits(chain: KinematicChain, q: Array) -> Cause | None:
    """The joint of ``q`` (J,) that is farthest out of its limits; None if all are within."""
    beyond = np.maximum(chain.lower - q, q - chain.upper)
    joint = int(np.argmax(beyond))
    return Cause(joint=joint, depth=float(beyond[joint])) if beyond[joint] > LIMIT_SLACK else None


def collision(arm: RobotSpheres, field: GaussianCollisionField, q: Array) -> Cause:
    """What ``q`` (J,) touches, the deepest of the map and of the arm itself; ``depth`` below 0 is room.

    Without anything within ``LOOK``, neither is named.
    """
    answer = arm.clearance(field, q[None], cut=LOOK)
    room, pair = self_room(arm, q)
    if room < answer.distance[0]:
        return Cause(int(pair[0]), int(pair[1]), -1, -room)
    return Cause(int(answer.link[0]), -1, int(answer.index[0]), -float(answer.distance[0]))


def self_room(arm: RobotSpheres, q: Array) -> tuple[float, tuple[int, int]]:
    """The least gap [m] between spheres of links that may not touch at ``q`` (J,), and those links; infinity: none."""
    at, radii, link = arm.centers(q[None])[0], arm.spheres.radii, arm.spheres.link
    apart = np.linalg.norm(at[:, None] - at[None], axis=-1) - radii[:, None] - radii[None]
    forbidden = np.zeros((link.max() + 1,) * 2, bool)
    forbidden[arm.pairs[:, 0], arm.pairs[:, 1]] = True
    apart[~forbidden[link[:, None], link[None]]] = np.inf
    a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return float(apart[a, b]), (int(link[a]), int(link[b]))


def blocked_line(arm: RobotSpheres, field: GaussianCollisionField, start: Array, goal: Array, eps: float) -> Cause:
    """What is first found in the way of the straight edge between two configurations (J,)."""
    edge = arm.certify(field, start[None], goal[None], eps=eps)
    if not edge.in_collision[0]:
        return Cause()
    return collision(arm, field, start + float(edge.at[0]) * (goal - start))
