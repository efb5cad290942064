"""Swept volumes of a gripper whose fingers move on a linkage, as a four-bar of Robotiq."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from splatbot.errors import FormatError
from splatbot.geometry import so3_exp, transform_points
from splatbot.protocols import Array
from splatbot.robots.reading import NamedShape
from splatbot.robots.shapes import Mesh, Shape
from splatbot.robots.urdf import MOVING, UrdfReader, number, origin


@dataclass(frozen=True)
class LinkageConstants:
    """Constants of swept volumes.

    Args:
        positions: number of positions of the linkage. Between two of them, a point on an arc leaves the hull of both by
            at most r (1 - cos(dθ / 2)), 8 µm for 0.1 m and 0.8 rad.
        turned: [rad] rotation up to which a link keeps its direction.
        moved: [m] motion up to which a link rests.
    """

    positions: int = 33
    turned: float = 1e-3
    moved: float = 1e-5


CONSTANTS = LinkageConstants()


@dataclass(frozen=True, eq=False)
class SweptHand:
    """Volumes that a gripper occupies at any opening, in the frame of its flange with the fingers opening along y.

    Args:
        body: its housing, and the hulls of its levers over all openings.
        finger: the links that translate with the pad on the side of +y, as hulls over all openings. The pad's face is
            at y = 0, and z is that of the flange: the pads of a four-bar move along z while they close.
        opening: (N,) distance between the pads at each position [m].
        tip: (N,) z of the finger tips at each position [m].
    """

    body: tuple[Shape, ...]
    finger: tuple[Shape, ...]
    opening: Array
    tip: Array


def sweep(reader: UrdfReader) -> SweptHand:
    """Compute the swept volumes of a gripper with one driven joint that the others mimic.

    1. Forward kinematics place every link at all positions of the driven joint.
    2. Links that move and keep their direction are the fingers, one group on each side. All others are the body.
    3. The volume of a moving mesh is that of the convex hulls of its corners at neighbouring positions.

    Raises:
        FormatError: several joints are driven, or there are not two fingers that keep their direction.
    """
    links = pose_links(reader)
    at, corners, fingers = links.at, links.corners, links.fingers
    ours = [_placed(at[link], corners[link]) for link, side in fingers.items() if side > 0]  # (N, V, 3)
    face = np.min([points[..., 1].min(axis=1) for points in ours], axis=0)
    finger = [hull for points in ours for hull in _hulls(points - face[:, None, None] * [0.0, 1.0, 0.0])]
    body: list[Shape] = []
    for link in corners:
        if link not in fingers:
            rests = np.abs(at[link] - at[link][0]).max() <= CONSTANTS.moved
            shapes = reader.shapes(link, 0, at[link][0])
            body += [named.shape for named in shapes] if rests else _hulls(_placed(at[link], corners[link]))
    tip = np.max([points[..., 2].max(axis=1) for points in ours], axis=0)
    return SweptHand(tuple(body), tuple(finger), links.opening, tip)


@dataclass(frozen=True, eq=False)
class PosedLinks:
    """Links of a gripper at N positions of its driven joint, in the frame of :class:`SweptHand`.

    Args:
        at: (N, 4, 4) poses of each link.
        corners: (V, 3) corners of the hull of each link that has geometry, in its own frame [m].
        fingers: links that translate, with the sign of their side along y.
        opening: (N,) distance between the pads [m].
    """

    at: Mapping[str, Array]
    corners: Mapping[str, Array]
    fingers: Mapping[str, float]
    opening: Array


def pose_links(reader: UrdfReader) -> PosedLinks:
    """Compute the poses of all links of a gripper with one driven joint; see :func:`sweep`.

    Raises:
        FormatError: several joints are driven, or there are not two fingers that keep their direction.
    """
    at = _positions(reader)
    corners = {link: _corners(reader.shapes(link, 0, np.eye(4))) for link in at}
    corners = {link: points for link, points in corners.items() if len(points)}
    fingers = [link for link in corners if _translates(at[link])]
    if not fingers:
        hint = "a parallel gripper has two fingers that keep their direction"
        raise FormatError("moves no link in a straight line.", file=reader.file, hint=hint)
    middle = {link: transform_points(at[link][0], corners[link]).mean(axis=0) for link in fingers}
    far = max(middle.values(), key=lambda p: float(np.linalg.norm(p[:2])))
    y = np.array([far[0], far[1], 0.0]) / np.linalg.norm(far[:2])
    turn = np.eye(4)
    turn[:3, :3] = np.stack([np.cross(y, [0.0, 0.0, 1.0]), y, [0.0, 0.0, 1.0]])
    at = {link: turn @ T for link, T in at.items()}
    sides = {link: float(np.sign(y @ middle[link])) for link in fingers}
    if set(sides.values()) != {-1.0, 1.0}:
        raise FormatError("has fingers on one side only.", file=reader.file, hint="give a gripper of two fingers")
    ours = [_placed(at[link], corners[link]) for link in fingers if sides[link] > 0]  # (N, V, 3)
    face = np.min([points[..., 1].min(axis=1) for points in ours], axis=0)
    theirs = [_placed(at[link], corners[link]) for link in fingers if sides[link] < 0]
    other = np.max([points[..., 1].max(axis=1) for points in theirs], axis=0)
    return PosedLinks(at, corners, sides, face - other)


def _positions(reader: UrdfReader) -> Mapping[str, Array]:
    """Return the poses (N, 4, 4) of every link in the frame of the first one, at all positions of the driven joint."""
    driven = [e for e in reader.joint_to.values() if e.get("type") in MOVING and e.find("mimic") is None]
    if len(driven) != 1:
        names = ", ".join(reader.name(e) for e in driven) or "none"
        hint = "let the other joints mimic one"
        raise FormatError(f"has {len(driven)} driven joints: {names}.", file=reader.file, hint=hint)
    limit = driven[0].find("limit")
    low, high = (number(limit.get(key)) if limit is not None else None for key in ("lower", "upper"))
    if low is None or high is None or not high > low:
        hint = "add lower and upper"
        raise FormatError("has no limits.", file=reader.file, field=reader.name(driven[0]), hint=hint)
    q = np.linspace(low, high, CONSTANTS.positions)
    at: dict[str, Array] = {reader.root_link(): np.tile(np.eye(4), (len(q), 1, 1))}
    for child, e in reader.outwards():
        at[child] = at[reader.link(e, "parent")] @ origin(e) @ _motion(reader, e, q)
    return at


def _motion(reader: UrdfReader, e: ElementTree.Element, q: Array) -> Array:
    """Return the transforms (N, 4, 4) of a joint at positions (N,) of the driven one."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    if e.get("type") not in MOVING:
        return T
    mimic = e.find("mimic")
    factor, offset = (
        (number(mimic.get("multiplier", "1")), number(mimic.get("offset", "0"))) if mimic is not None else (1.0, 0.0)
    )
    if factor is None or offset is None:
        raise FormatError("has a <mimic> without numbers.", file=reader.file, field=reader.name(e), hint="correct it")
    own, axis = factor * q + offset, reader.axis(e)
    if e.get("type") == "prismatic":
        T[:, :3, 3] = own[:, None] * axis
    else:
        T[:, :3, :3] = [so3_exp(value * axis) for value in own]
    return T


def _translates(T: Array) -> bool:
    """Return whether poses (N, 4, 4) move without a rotation."""
    turned = np.abs(T[:, :3, :3] - T[0, :3, :3]).max()
    return bool(turned <= CONSTANTS.turned and np.abs(T[:, :3, 3] - T[0, :3, 3]).max() > CONSTANTS.moved)


def _hulls(points: Array) -> list[Shape]:
    """Return the convex hulls of corners at neighbouring positions (N, V, 3)."""
    found: list[Shape] = []
    for k in range(len(points) - 1):
        hull = trimesh.convex.convex_hull(np.concatenate(points[k : k + 2]))
        found.append(Mesh(0, np.asarray(hull.vertices), np.asarray(hull.faces, dtype=np.int64)))
    return found


def _placed(T: Array, points: Array) -> Array:
    """Return points (V, 3) at poses (N, 4, 4), as (N, V, 3)."""
    return np.asarray(points @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3])


def _corners(shapes: Sequence[NamedShape]) -> Array:
    """Return the corners (V, 3) of the convex hull of shapes [m]."""
    found = [named.shape.triangles().reshape(-1, 3) for named in shapes]
    return np.asarray(trimesh.convex.convex_hull(np.concatenate(found)).vertices) if found else np.zeros((0, 3))
