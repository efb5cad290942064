"""Model of a robot arm: kinematics, limits, collision geometry and its cover of spheres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array, HandShape, KinematicChain, LinkSpheres
from splatbot.robots.cover import cover
from splatbot.robots.joints import Joint, chain_of
from splatbot.robots.link_frames import LinkFrames
from splatbot.robots.shapes import Mesh, Shape


@dataclass(frozen=True)
class CoverConstants:
    """Constants of the spheres and the hand of a robot.

    Args:
        slack: [m] distance by which generated spheres may extend beyond the collision geometry.
        pad_depth: [m] depth of the layer of a finger that counts as the face of its pad.
        spacing: [m] distance between the surface points from which the dimensions of the hand are measured.
    """

    slack: float = 0.008
    pad_depth: float = 1e-4
    spacing: float = 2e-3


CONSTANTS = CoverConstants()


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass [kg], its centre (3,) [m, link frame] and inertia about it (3, 3) [kg m²] along the link's axes."""

    mass: float
    center: tuple[float, float, float]
    inertia: Array

    @classmethod
    def summed(cls, parts: Sequence[tuple[float, Array, Array]]) -> Inertial:
        """Sum the mass, its centre (3,) and the inertia about it (3, 3) of bodies that are fixed to each other.

        By the parallel axis theorem, I = sum_i I_i + m_i (|r_i|² E - r_i r_iᵀ) with r_i the offset of the centres.
        """
        mass = sum(m for m, _, _ in parts)
        if mass <= 0:
            return cls(0.0, (0.0, 0.0, 0.0), np.zeros((3, 3)))
        c = np.sum([m * center for m, center, _ in parts], axis=0) / mass
        total = np.zeros((3, 3))
        for m, center, inertia in parts:
            r = center - c
            total += inertia + m * (r @ r * np.eye(3) - np.outer(r, r))
        return cls(float(mass), (float(c[0]), float(c[1]), float(c[2])), total)


@dataclass(frozen=True, eq=False)
class GripperGeometry:
    """Two fingers on the last link that open symmetrically.

    Args:
        T_link_finger: (2, 4, 4) pose of each finger when closed [m]; its y axis points in the direction of opening.
        stroke: travel of each finger [m].
        shapes: shapes of one finger in its own frame; their ``link`` is ignored.
        speed: speed of each finger [m/s].
        force: force between the fingers [N].
        covering: spheres of one finger in its own frame; their ``link`` is ignored. If None, they are generated from
            the shapes.
        hand: boxes around fingers and palm. If None, they are measured on the shapes of gripper and last link.
    """

    T_link_finger: Array
    stroke: float
    shapes: tuple[Shape, ...]
    speed: float = 0.2
    force: float = 70.0
    covering: LinkSpheres | None = field(default=None, repr=False)
    hand: HandShape | None = None


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Model of a serial arm.

    Args:
        name: name of the robot.
        joints: joints from the base outwards.
        shapes: collision geometry of the links; 0 is the base, link k moves with joint k - 1.
        T_link_tcp: (4, 4) pose of the tool on the last link [m].
        home: (J,) home posture [rad or m].
        inertials: inertias of the links 0..J for the twin; empty if unknown.
        gripper: fingers, or None.
        slack: distance by which the spheres may extend beyond the shapes [m].
        allowed: pairs of links that may touch, in addition to neighbours and links whose spheres overlap at home.
        covering: spheres of the links. If None, they are generated from the shapes.
        pairs: (M, 2) links that may not touch. If None, they are derived from the spheres.
        visual: visual meshes of links, for pictures alone.
        link_frames: frames of the links in TF; None if its description does not name them.
        joint_offsets: (J,) offsets that ``joints`` include, of :func:`splatbot.robots.joint_offsets.robot_in_scene`
            [rad or m]; empty without them.

    Raises:
        InputError: joints, home, shapes and frames are inconsistent.
    """

    name: str
    joints: tuple[Joint, ...]
    shapes: tuple[Shape, ...] = field(repr=False)
    T_link_tcp: Array = field(repr=False)
    home: Array
    inertials: tuple[Inertial, ...] = field(default=(), repr=False)
    gripper: GripperGeometry | None = field(default=None, repr=False)
    slack: float = CONSTANTS.slack
    allowed: tuple[tuple[int, int], ...] = ()
    covering: LinkSpheres | None = field(default=None, repr=False)
    pairs: NDArray[np.int32] | None = field(default=None, repr=False)
    visual: tuple[Mesh, ...] = field(default=(), repr=False)
    link_frames: LinkFrames | None = field(default=None, repr=False)
    joint_offsets: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.home) != len(self.joints):
            raise InputError(f"has {len(self.home)} values for {len(self.joints)} joints.", field="home")
        if any(not 0 <= shape.link <= len(self.joints) for shape in self.shapes):
            raise InputError("names a link that is not there.", field="shapes", hint=f"links are 0..{len(self.joints)}")
        if self.link_frames is not None and len(self.link_frames.names) != len(self.joints) + 1:
            problem = f"names {len(self.link_frames.names)} links for {len(self.joints)} joints."
            raise InputError(problem, field="link_frames", hint="name the base and one link for each joint")

    def __len__(self) -> int:
        """Return the number of joints."""
        return len(self.joints)

    @cached_property
    def chain(self) -> KinematicChain:
        """Joints and their limits."""
        return chain_of(self.joints)

    def fk(self, q: ArrayLike) -> Array:
        """Compute the poses T_base_link (..., J + 1, 4, 4) of all links at configurations (..., J) [rad or m]."""
        values = self.configurations(q)
        T = np.empty((*values.shape[:-1], len(self) + 1, 4, 4))
        T[..., 0, :, :] = np.eye(4)
        for k, joint in enumerate(self.joints):
            T[..., k + 1, :, :] = (
                T[..., k, :, :] @ joint.T_before_joint @ joint_transform(values[..., k], joint.prismatic)
            )
        return T

    def tcp(self, q: ArrayLike) -> Array:
        """Compute the poses T_base_tcp (..., 4, 4) of the tool at configurations (..., J) [rad or m]."""
        return np.asarray(self.fk(q)[..., -1, :, :] @ self.T_link_tcp)

    def jacobian(self, q: ArrayLike, link: int | None = None, point: ArrayLike | None = None) -> Array:
        """Compute the geometric Jacobian (..., 6, J): velocity and angular velocity of a point per joint velocity.

        Column j of a revolute joint with axis z and origin o is (z × (p - o), z), that of a prismatic joint (z, 0).

        Args:
            q: configurations (..., J) [rad or m].
            link: link of the point; the last by default.
            point: point p, (3,) or (..., 3), in the frame of the base [m]; the origin of the tool by default.
        """
        T = self.fk(q)
        last = len(self) if link is None else link
        p = (T[..., -1, :, :] @ self.T_link_tcp)[..., :3, 3] if point is None else np.asarray(point, dtype=np.float64)
        J = np.zeros((*T.shape[:-3], 6, len(self)))
        for k in range(last):
            z, at = T[..., k + 1, :3, 2], T[..., k + 1, :3, 3]
            if self.joints[k].prismatic:
                J[..., :3, k] = z
            else:
                J[..., :3, k] = np.cross(z, p - at)
                J[..., 3:, k] = z
        return J

    def spheres(self, opening: float | None = None) -> LinkSpheres:
        """Return spheres that cover the shapes, with ``opening`` [m] between the fingers.

        If None, the gripper is fully open.

        Raises:
            InputError: the opening is out of range.
        """
        if self.gripper is None:
            return self.link_spheres
        widest = 2 * self.gripper.stroke
        width = widest if opening is None else opening
        if not 0 <= width <= widest:
            raise InputError(f"is {width}.", field="opening", hint=f"give 0..{widest:g} m")
        centers, radii = [self.link_spheres.centers], [self.link_spheres.radii]
        for T in self.gripper.T_link_finger:
            moved = self.finger_spheres.centers + np.array([0.0, width / 2, 0.0])
            centers.append(moved @ T[:3, :3].T + T[:3, 3])
            radii.append(self.finger_spheres.radii)
        fingers = np.full(2 * len(self.finger_spheres), len(self), np.int32)
        return LinkSpheres(
            np.concatenate([self.link_spheres.link, fingers]), np.concatenate(centers), np.concatenate(radii)
        )

    @cached_property
    def hand(self) -> HandShape | None:
        """Boxes around the shapes of the gripper, whose fingers open along the tool's y axis; None without one."""
        if self.gripper is None:
            return None
        if self.gripper.hand is not None or not self.gripper.shapes:
            return self.gripper.hand
        T_tcp_link = inverse(self.T_link_tcp)
        T_tcp_finger = T_tcp_link @ self.gripper.T_link_finger[0]
        finger = np.concatenate([shape.surface(CONSTANTS.spacing) for shape in self.gripper.shapes])
        finger = transform_points(T_tcp_finger, finger) * [1.0, np.sign(T_tcp_finger[1, 1]), 1.0]
        pad = finger[finger[:, 1] < finger[:, 1].min() + CONSTANTS.pad_depth]
        own = [shape.surface(CONSTANTS.spacing) for shape in self.shapes if shape.link == len(self)]
        body = transform_points(T_tcp_link, np.concatenate(own)) if own else np.zeros((0, 3))
        palm = body[body[:, 2] > finger[:, 2].min()]  # parts next to the fingers or between them
        front = palm if len(palm) else finger[finger[:, 2] == finger[:, 2].min()]
        return HandShape(
            stroke=2 * self.gripper.stroke,
            width=float(2 * np.abs(finger[:, 0]).max()),
            thickness=float(np.ptp(finger[:, 1])),
            tip=float(finger[:, 2].max()),
            pad=float(pad[:, 2].max()),
            pad_width=float(2 * np.abs(pad[:, 0]).max()),
            palm=float(-front[:, 2].max()),
            palm_size=(float(2 * np.abs(front[:, 0]).max()), float(2 * np.abs(front[:, 1]).max())),
            force=self.gripper.force,
        )

    @cached_property
    def self_collision_pairs(self) -> NDArray[np.int32]:
        """Pairs (M, 2) of links that may not touch.

        These are all pairs except neighbours, allowed pairs, and links whose spheres overlap at home.
        """
        if self.pairs is not None:
            return self.pairs
        s = self.spheres()
        T = self.fk(self.home)[s.link]
        at = np.einsum("sij,sj->si", T[:, :3, :3], s.centers) + T[:, :3, 3]
        touch = np.linalg.norm(at[:, None] - at[None], axis=-1) <= s.radii[:, None] + s.radii[None]
        links = sorted(set(s.link.tolist()))
        pairs = [
            (a, b)
            for a in links
            for b in links
            if b > a + 1 and (a, b) not in self.allowed and not touch[np.ix_(s.link == a, s.link == b)].any()
        ]
        return np.array(pairs, dtype=np.int32).reshape(-1, 2)

    def random(self, count: int, rng: np.random.Generator) -> Array:
        """Draw configurations (count, J) [rad or m], uniform within the limits."""
        return rng.uniform(self.chain.lower, self.chain.upper, (count, len(self)))

    def within_limits(self, q: ArrayLike, tolerance: float = 0.0) -> NDArray[np.bool_]:
        """Return whether configurations (..., J) respect the position limits within a tolerance [rad or m]."""
        values = self.configurations(q)
        low, high = self.chain.lower - tolerance, self.chain.upper + tolerance
        return np.asarray(((values >= low) & (values <= high)).all(axis=-1))

    def configurations(self, q: ArrayLike) -> Array:
        """Return ``q`` as finite float64 (..., J).

        Raises:
            InputError: ``q`` has another number of joints, or a value is not finite.
        """
        values = np.asarray(q, dtype=np.float64)
        if values.ndim < 1 or values.shape[-1] != len(self):
            raise InputError(f"is {values.shape}.", field="q", hint=f"{self.name} has {len(self)} joints")
        if not np.isfinite(values).all():
            raise InputError("has values that are not finite.", field="q", hint="give radians and metres")
        return values

    @cached_property
    def link_spheres(self) -> LinkSpheres:
        """Spheres that cover the shapes of the links, without fingers."""
        return _covered(self.shapes, self.slack) if self.covering is None else self.covering

    @cached_property
    def finger_spheres(self) -> LinkSpheres:
        """Spheres of one finger in its own frame; none without a gripper."""
        if self.gripper is not None and self.gripper.covering is not None:
            return self.gripper.covering
        return _covered(self.gripper.shapes if self.gripper else (), self.slack / 2)


def _covered(shapes: Sequence[Shape], slack: float) -> LinkSpheres:
    if not shapes:
        return LinkSpheres(np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros(0))
    return cover(shapes, slack)


def joint_transform(q: Array, prismatic: bool) -> Array:
    """Return the transforms (..., 4, 4) of a joint about or along z."""
    T = np.zeros((*q.shape, 4, 4))
    T[..., range(4), range(4)] = 1.0
    if prismatic:
        T[..., 2, 3] = q
    else:
        T[..., 0, 0] = T[..., 1, 1] = np.cos(q)
        T[..., 1, 0] = np.sin(q)
        T[..., 0, 1] = -np.sin(q)
    return T
