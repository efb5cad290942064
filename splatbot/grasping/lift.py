"""Straight lift of a target in the closed hand, certified against the map without the target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import Target
from splatbot.grasping.attached import CONSTANTS as ATTACHED
from splatbot.grasping.attached import object_spheres
from splatbot.grasping.obstacles import Surfaces
from splatbot.planning import Path
from splatbot.planning.cartesian import straight_line
from splatbot.protocols import Array

if TYPE_CHECKING:
    from splatbot.grasping.sampler import GraspSampler


@dataclass(frozen=True, eq=False)
class Lift:
    """A certified lift in two parts.

    Args:
        attached: (A, 4) spheres (x, y, z, radius) [m] of the target in the frame of the last link.
        closed: the arm with the closed fingers, for the first part.
        loaded: the same with the target in the hand, for the second part.
        off: path of the first part, on which the target separates from its support.
        up: path of the second part.
    """

    attached: Array
    closed: RobotSpheres
    loaded: RobotSpheres
    off: Path
    up: Path


def lift_target(
    sampler: GraspSampler,
    spheres: Array,
    around_held: GaussianCollisionField,
    surfaces: Surfaces,
    q: Array,
    width: float,
    *,
    lift_off: float,
    height: float,
) -> Lift | str:
    """Lift a target straight up, or return why it cannot be lifted, as a clause.

    Only the closed hand is certified on the first part, since the target is still in contact with its support. The
    target in the hand is certified on the second part. A neighbour that touches it there may be moved by the lift, so
    that no contact is exempt.

    Args:
        sampler: of the map; its robot, base and margin apply.
        spheres: (A, 4) spheres (x, y, z, radius) that cover the target [m, world].
        around_held: field of the map without the target and its strays.
        surfaces: names of the surfaces of that field.
        q: (J,) joint positions at the grasp.
        width: of the closed hand [m].
        lift_off: height of the first part [m].
        height: of the whole lift [m].
    """

    def arm(attached: Array | None) -> RobotSpheres:
        return RobotSpheres(
            sampler.robot,
            T_world_base=sampler.scene.T_world_base,
            opening=width,
            attached=attached,
            margin=sampler.margin,
        )

    closed = arm(None)
    attached = in_hand(closed, q, spheres)
    loaded = arm(attached)
    off = straight_line(closed, around_held, q, raised(sampler, closed, q, lift_off))
    if not off or off.path is None:
        return f"it cannot be lifted: {surfaces.reason(off)}"
    top = off.path.waypoints[-1]
    up = straight_line(loaded, around_held, top, raised(sampler, loaded, top, height - lift_off))
    if not up or up.path is None:
        return f"it cannot be lifted: {1e3 * lift_off:.0f} mm up, {surfaces.reason(up)}"
    return Lift(attached, closed, loaded, off.path, up.path)


def target_spheres(sampler: GraspSampler, target: Target) -> Array:
    """Cover the completed surface of a target by spheres (A, 4), at most as many as the arm can carry with its own.

    See :func:`splatbot.grasping.attached.object_spheres`.
    """
    room = max(1, ATTACHED.max_arm_spheres - len(sampler.robot.spheres()))
    return object_spheres(sampler.surface(target), max_spheres=min(ATTACHED.max_spheres, room))


def in_hand(arm: RobotSpheres, q: Array, spheres: Array) -> Array:
    """Transform spheres (A, 4) from the world to the frame of the last link at joint positions ``q`` (J,)."""
    T_link_world = inverse(arm.forward(q[None])[0, -1])
    return np.c_[transform_points(T_link_world, spheres[:, :3]), spheres[:, 3]]


def raised(sampler: GraspSampler, arm: RobotSpheres, q: Array, height: float) -> Array:
    """Return the tool pose T_world_tcp (4, 4) at ``q`` (J,), raised by ``height`` [m] along the up axis."""
    T = np.asarray(arm.forward(q[None])[0, -1] @ sampler.robot.T_link_tcp)
    T[:3, 3] += height * sampler.scene.up
    return T
