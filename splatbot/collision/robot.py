"""Collision checks of a robot's spheres with the map and with each other: configurations and edges in joint space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot._native import ARM_SELF, Arm
from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.inputs import rows
from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.protocols import Array, LinkSpheres, RobotKinematics

EPS = 1e-3  # [m]; an edge on which a sphere has less clearance is not certified


@dataclass(frozen=True)
class ConfigurationResult:
    """Collision checks of C configurations.

    Args:
        in_collision: (C,); false is certain for the ellipsoids of the map.
        link: (C,) int32, link that may be in contact, -1 for a free configuration.
        other: (C,) int32, link that it may touch, -1 for the map or for a free configuration.
        map_version: version of the map; -1 if only self-collision is checked.
    """

    in_collision: NDArray[np.bool_]
    link: NDArray[np.int32]
    other: NDArray[np.int32]
    map_version: int


@dataclass(frozen=True)
class EdgeResult(ConfigurationResult):
    """Collision checks of E edges.

    Args:
        at: (E,) position on the edge (0..1) at which it was rejected; 1 for a free edge.
        checked: (E,) int32, number of configurations that were checked.
    """

    at: NDArray[np.float32]
    checked: NDArray[np.int32]


@dataclass(frozen=True)
class ArmClearanceResult:
    """Clearance of C configurations from the map.

    Args:
        distance: (C,) lower bound of the smallest clearance of any sphere [m]; infinity beyond the cut.
        gradient: (C, J) derivative of the distance with respect to the joints [m per rad or m]; 0 beyond the cut.
        link: (C,) int32, link of that sphere, -1 beyond the cut.
        index: (C,) int64, row of the Gaussian in the model, -1 beyond the cut.
        map_version: version of the map.
    """

    distance: Array
    gradient: Array
    link: NDArray[np.int32]
    index: NDArray[np.int64]
    map_version: int


class RobotSpheres:
    """Collision model of a robot: spheres on its links, for queries against a field and against each other.

    Args:
        robot: kinematic chain, spheres of the links, and pairs of links that may not touch.
        T_world_base: (4, 4) pose of the base [m]. If None, the base is at the origin.
        opening: opening of the gripper [m]. If None, the gripper is fully open.
        attached: (A, 4) spheres (x, y, z, radius) of a grasped object in the frame of the last link [m].
        base_in_map: check the spheres of the base against the map, which usually contains the stand of the robot.
        margin: clearance that every sphere keeps to the map [m]. It does not apply to self-collision. See
            :func:`splatbot.collision.surface_error`.

    Raises:
        InputError: T_world_base is no rigid pose, attached or margin is invalid, or the arm exceeds 16 joints, 640
            spheres or 256 pairs.
    """

    def __init__(
        self,
        robot: RobotKinematics,
        *,
        T_world_base: ArrayLike | None = None,
        opening: float | None = None,
        attached: ArrayLike | None = None,
        base_in_map: bool = False,
        margin: float = 0.0,
    ) -> None:
        if not 0.0 <= margin < np.inf:
            raise InputError(f"is {margin}.", field="margin", hint="give metres, 0 or more")
        self.robot = robot
        self.base_in_map = base_in_map
        self.margin = float(margin)
        self.T_world_base = _rigid(np.eye(4) if T_world_base is None else T_world_base)
        own = robot.spheres(opening)
        self.spheres = _with(own, len(robot.chain), attached)
        self.own_count = len(own.link)  # the spheres behind these are those of the attached object
        self.pairs = np.ascontiguousarray(robot.self_collision_pairs, dtype=np.int32).reshape(-1, 2)
        chain = robot.chain
        try:
            self.native = Arm(
                joints=np.ascontiguousarray(chain.T_before_joint[:, :3, :]),
                prismatic=chain.prismatic.astype(np.uint8),
                travel=np.maximum(np.abs(chain.lower), np.abs(chain.upper)),
                link=np.ascontiguousarray(self.spheres.link, dtype=np.int32),
                centers=np.ascontiguousarray(self.spheres.centers),
                radii=np.ascontiguousarray(self.spheres.radii),
                pairs=self.pairs,
                base=np.ascontiguousarray(self.T_world_base[:3]),
                base_in_map=base_in_map,
                margin=self.margin,
            )
        except ValueError as error:
            raise InputError(f"{error}.", field=robot.name, hint="give an arm of fewer parts") from error

    def centers(self, q: ArrayLike) -> Array:
        """Compute the centres (C, S, 3) of the spheres [m, world] at configurations (C, J)."""
        centers: Array = self.native.centers(self._joints(q, "q"))
        return centers

    def forward(self, q: ArrayLike) -> Array:
        """Compute the poses T_world_link (C, J + 1, 4, 4) at configurations (C, J)."""
        poses: Array = self.native.forward(self._joints(q, "q"))
        return poses

    def base_in_map_above(self, field: GaussianCollisionField, height: float) -> bool:
        """Return whether the part of the base above a height [m] over its foot may be in the map.

        The base stands on a surface of the map, so that its foot always touches. Each sphere is cut at the height: the
        largest sphere with the same centre above it is checked.
        """
        base = self.spheres.link == 0
        centers, radii = self.spheres.centers[base], self.spheres.radii[base]
        cut = np.minimum(radii, centers[:, 2] - height)
        at = transform_points(self.T_world_base, centers[cut > 0])
        return bool(field.in_collision(np.c_[at, cut[cut > 0]]).any())

    def check(self, field: GaussianCollisionField | None, q: ArrayLike) -> ConfigurationResult:
        """Check whether configurations (C, J) may collide with the map or with themselves.

        Args:
            field: collision field. If None, only self-collision is checked.
            q: configurations (C, J) [rad or m].

        Raises:
            InputError: ``q`` has a wrong shape or is not finite.
        """
        verdict = self.native.configurations(_native(field), self._joints(q, "q"))
        return ConfigurationResult(verdict >= 0, *self._links(verdict), _version(field))

    def clearance(self, field: GaussianCollisionField, q: ArrayLike, *, cut: float = np.inf) -> ArmClearanceResult:
        """Compute the clearance of configurations from the map, less the margin, and its gradient in joint space.

        Args:
            field: collision field.
            q: configurations (C, J) [rad or m].
            cut: search distance [m].

        Raises:
            InputError: ``q`` has a wrong shape or is not finite, or the cut is negative.
        """
        if not cut >= 0.0:
            raise InputError(f"is {cut}.", field="cut", hint="give metres, 0 or more")
        joints = self._joints(q, "q")
        distance, normal, center, sphere, names = self.native.clearance(field.native, joints, cut)
        link = np.where(sphere >= 0, self.spheres.link[sphere], -1).astype(np.int32)
        gradient = self._gradient(joints, normal, center, link)
        return ArmClearanceResult(distance, gradient, link, field.rows_of(names), field.map_version)

    def certify(
        self, field: GaussianCollisionField | None, start: ArrayLike, end: ArrayLike, *, eps: float = EPS
    ) -> EdgeResult:
        """Certify that every configuration on straight edges in joint space is free of collisions.

        The check is continuous and conservative. An interval of an edge is free if each sphere moves less than its
        clearance d at the midpoint. With the speed v at the midpoint, a bound a of the acceleration, and the
        half-width h::

            v h + a h² / 2 < d

        Other intervals are bisected. An edge is rejected if a configuration may collide, or if a sphere has a clearance
        below ``eps``.

        Args:
            field: collision field. If None, only self-collision is checked.
            start: (E, J) configurations [rad or m].
            end: (E, J) configurations [rad or m].
            eps: resolution [m].

        Raises:
            InputError: the ends differ in shape, or eps is below 1e-5 m.
        """
        if not 1e-5 <= eps < np.inf:
            raise InputError(f"is {eps}.", field="eps", hint="give metres, at least 0.00001")
        return self._edges(field, self.native.certify(_native(field), *self._ends(start, end), eps))

    def still_free(
        self,
        before: GaussianCollisionField,
        now: GaussianCollisionField,
        start: ArrayLike,
        end: ArrayLike,
        *,
        eps: float = EPS,
    ) -> EdgeResult:
        """Certify edges on the field ``now`` that are certified on ``before``; only added Gaussians are checked.

        Raises:
            InputError: an argument is invalid, as in :meth:`certify`, or the fields differ in n_sigma.
        """
        return self.without_pairs.certify(now.added_since(before), start, end, eps=eps)

    def grown(self, by: float) -> RobotSpheres:
        """Return the same arm with every sphere enlarged by ``by`` [m], against the map and against itself."""
        return RobotSpheres(
            _RobotVariant(
                self, LinkSpheres(self.spheres.link, self.spheres.centers, self.spheres.radii + by), self.pairs
            ),
            T_world_base=self.T_world_base,
            base_in_map=self.base_in_map,
            margin=self.margin,
        )

    def without_hand(self, margin: float) -> RobotSpheres:
        """Return the links before the hand alone, with another margin [m] to the map and no self-collision checks."""
        keep = self.spheres.link < len(self.robot.chain)
        links = LinkSpheres(self.spheres.link[keep], self.spheres.centers[keep], self.spheres.radii[keep])
        return RobotSpheres(
            _RobotVariant(self, links, np.zeros((0, 2), np.int32)),
            T_world_base=self.T_world_base,
            base_in_map=self.base_in_map,
            margin=margin,
        )

    @cached_property
    def reach(self) -> Array:
        """Largest motions (K, J) of spheres per unit of each joint [m per rad or m].

        A row belongs to one sphere. Spheres that another one exceeds in every joint have none, so that
        ``(abs(dq) @ reach.T).max()`` bounds the motion of every sphere at the cost of few.
        """
        rows = np.unique(np.asarray(self.native.reach(), dtype=np.float64), axis=0)
        exceeds = (rows[None, :] >= rows[:, None]).all(axis=2)  # [k, i]: row i exceeds row k; each exceeds itself
        return np.ascontiguousarray(rows[exceeds.sum(axis=1) == 1])

    @cached_property
    def reach_radius(self) -> float:
        """Radius [m] of a ball around the base that contains the arm in every configuration."""
        last = self.spheres.link == self.spheres.link.max()
        T = np.eye(4)  # on the last link, as far away as its farthest point
        T[2, 3] = float((np.linalg.norm(self.spheres.centers[last], axis=1) + self.spheres.radii[last]).max())
        return self.robot.chain.reach(T)

    @cached_property
    def without_pairs(self) -> RobotSpheres:
        """The same arm without self-collision checks."""
        return RobotSpheres(
            _RobotVariant(self, self.spheres, np.zeros((0, 2), np.int32)),
            T_world_base=self.T_world_base,
            base_in_map=self.base_in_map,
            margin=self.margin,
        )

    def sample(
        self, field: GaussianCollisionField | None, start: ArrayLike, end: ArrayLike, *, samples: int = 32
    ) -> EdgeResult:
        """Check ``samples`` configurations of each edge, both ends included; the rest of the edge is not checked.

        This is faster than :meth:`certify` and gives no certificate.

        Raises:
            InputError: the ends differ in shape, or samples is out of range.
        """
        if not 1 <= samples <= 1 << 20:
            raise InputError(f"is {samples}.", field="samples", hint="give 1..1048576")
        return self._edges(field, self.native.sample(_native(field), *self._ends(start, end), samples))

    def _edges(self, field: GaussianCollisionField | None, answer: tuple[NDArray[np.int32], ...]) -> EdgeResult:
        verdict, at, checked = answer
        link, other = self._links(verdict)
        return EdgeResult(verdict >= 0, link, other, _version(field), at.astype(np.float32), checked)

    def _ends(self, start: ArrayLike, end: ArrayLike) -> tuple[Array, Array]:
        a, b = self._joints(start, "start"), self._joints(end, "end")
        if len(a) != len(b):
            raise InputError(f"has {len(b)} rows for {len(a)} of start.", field="end", hint="give one end for each")
        return a, b

    def _joints(self, q: ArrayLike, name: str) -> Array:
        values = np.asarray(q, dtype=np.float64)
        return rows(values[None] if values.ndim == 1 else values, name, len(self.robot.chain), "joint values")

    def _links(self, verdict: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the link and the link that it may touch, from native verdicts."""
        link, other = np.full(len(verdict), -1, np.int32), np.full(len(verdict), -1, np.int32)
        pair = verdict - ARM_SELF
        own, touched = pair >= 0, (verdict >= 0) & (pair < 0)
        link[touched] = self.spheres.link[verdict[touched]]
        other[own], link[own] = self.pairs[pair[own]].T
        return link, other

    def _gradient(self, q: Array, normal: Array, center: Array, link: NDArray[np.int32]) -> Array:
        """Compute d distance / d q = n · (z × (c - o)), or n · z for a prismatic joint."""
        T = self.native.forward(q)[:, 1:]
        z, at = T[..., :3, 2], T[..., :3, 3]
        turning = np.einsum("cji,ci->cj", np.cross(z, center[:, None] - at), normal)
        sliding = np.einsum("cji,ci->cj", z, normal)
        gradient = np.where(self.robot.chain.prismatic, sliding, turning)
        return np.where(np.arange(q.shape[1]) < link[:, None], gradient, 0.0)


class _RobotVariant:
    """A robot with replaced spheres or replaced pairs of links that may not touch."""

    def __init__(self, arm: RobotSpheres, spheres: LinkSpheres, pairs: NDArray[np.int32]) -> None:
        self.name, self.chain, self.home = arm.robot.name, arm.robot.chain, arm.robot.home
        self.self_collision_pairs = pairs
        self._spheres = spheres

    def spheres(self, opening: float | None = None) -> LinkSpheres:
        return self._spheres


def _with(spheres: LinkSpheres, last: int, attached: ArrayLike | None) -> LinkSpheres:
    """Append the spheres of a grasped object to those of the links."""
    extra = (
        np.zeros((0, 4)) if attached is None else rows(np.asarray(attached), "attached", 4, "metres (x, y, z, radius)")
    )
    if (extra[:, 3] < 0).any():
        raise InputError("has a radius below 0.", field="attached", hint="give (x, y, z, radius) in metres")
    return LinkSpheres(
        np.concatenate([spheres.link, np.full(len(extra), last, np.int32)]),
        np.concatenate([spheres.centers, extra[:, :3]]),
        np.concatenate([spheres.radii, extra[:, 3]]),
    )


def _rigid(T: ArrayLike) -> Array:
    pose = np.asarray(T, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError(f"is {pose.shape} or not finite.", field="T_world_base", hint="give a (4, 4) pose")
    if np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > 1e-6 or np.linalg.det(pose[:3, :3]) < 0:
        raise InputError("is no rotation.", field="T_world_base", hint="give an orthonormal, right-handed rotation")
    return pose


def _native(field: GaussianCollisionField | None) -> object:
    return None if field is None else field.native


def _version(field: GaussianCollisionField | None) -> int:
    return -1 if field is None else field.map_version
