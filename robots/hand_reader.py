"""Reader of a parallel gripper from a URDF file."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from splatbot.errors import FormatError
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array, HandShape
from splatbot.robots.containment import uncovered
from splatbot.robots.cover import cover
from splatbot.robots.hands import Hand, moved
from splatbot.robots.robot import CONSTANTS as COVER
from splatbot.robots.shapes import Capsule, Shape
from splatbot.robots.urdf import MOVING, UrdfReader, number, origin, parse


@dataclass(frozen=True)
class HandConstants:
    """Constants of the reader.

    Args:
        parallel: cosine above which two directions are the same.
        upright: cosine below which the direction of opening is across the z axis of the first link.
        same: [m] distance up to which both fingers count as the same shape.
        depth: [m] distance of the tool frame from the tips, at most.
        share: the same relative to the length of the fingers.
        gap: [m] gap between closed fingers above which a note states it.
        force: [N] between the fingers, if the file has no effort.
        speed: [m/s] of a finger, if the file has no velocity.
        mass: [kg] if the file has none.
    """

    parallel: float = 0.999
    upright: float = 0.02
    same: float = 2e-4
    depth: float = 0.01
    share: float = 0.25
    gap: float = 1e-3
    force: float = 20.0
    speed: float = 0.05
    mass: float = 0.5


CONSTANTS = HandConstants()


@dataclass(frozen=True)
class HandReading:
    """Hand of a file, and the assumptions that replace missing values."""

    hand: Hand
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Finger:
    """One finger in the frame of the first link, at the value 0 of its joint.

    Args:
        joint: its element.
        shapes: of its link and the links that it carries [m].
        along: (3,) unit direction in which the joint moves it.
        limits: lower and upper [m].
    """

    joint: ElementTree.Element
    shapes: Sequence[Shape]
    along: Array
    limits: tuple[float, float]

    def vertices(self) -> Array:
        """Return the corners (V, 3) of its geometry [m]."""
        return _corners(self.shapes)


def read_hand(path: str | Path) -> HandReading:
    """Read a parallel gripper: two prismatic fingers, which face each other across the z axis of the first link.

    The fingers open along a line across this axis, and reach along it. The first link is the flange. The tool frame
    lies between the fingers, a quarter of their length and at most 10 mm before their tips.

    Args:
        path: URDF file, or a xacro file if the package xacro is installed.

    Raises:
        FormatError: the file is no URDF, is no such gripper, or contains an invalid element, which the error names.
    """
    file = Path(path)
    root = parse(file)
    if root.tag != "robot":
        raise FormatError(f"its root is <{root.tag}>.", file=file, hint="give the URDF of a gripper")
    reader = UrdfReader(file, root)
    joints = [e for e in reader.joint_to.values() if e.get("type") in MOVING]
    if len(joints) != 2 or any(e.get("type") != "prismatic" for e in joints):
        kinds = ", ".join(f"{reader.name(e)} ({e.get('type')})" for e in joints) or "none"
        hint = "describe the fingers by two prismatic joints, or take --gripper 2f85, 2f140 or panda_hand"
        raise FormatError(f"is no parallel gripper; its moving joints: {kinds}.", file=file, hint=hint)
    body, fingers = _parts(reader, joints)
    return _assembled(file, root.get("name") or file.stem, body, fingers, _mass(reader))


def _parts(reader: UrdfReader, joints: Sequence[ElementTree.Element]) -> tuple[list[Shape], list[_Finger]]:
    """Return the shapes of the body and both fingers in the frame of the first link."""
    placed: dict[str, tuple[int, Array]] = {reader.root_link(): (0, np.eye(4))}  # 0: body, k: finger k
    along: dict[int, Array] = {}
    for child, e in reader.outwards():
        part, T = placed[reader.link(e, "parent")]
        T = T @ origin(e)
        if e in joints:
            if part:
                raise FormatError("carries a finger.", file=reader.file, field=reader.name(joints[part - 1]))
            part = joints.index(e) + 1
            along[part] = T[:3, :3] @ reader.axis(e)
        placed[child] = (part, T)
    shapes: list[list[Shape]] = [[], [], []]
    for link, (part, T) in placed.items():
        shapes[part] += [named.shape for named in reader.shapes(link, 0, T)]
    limits = _limits(reader, joints)
    for e, own in zip(joints, shapes[1:], strict=True):
        if not own:
            hint = "give the finger collision or visual geometry"
            raise FormatError("moves no geometry.", file=reader.file, field=reader.name(e), hint=hint)
    fingers = [_Finger(e, shapes[k + 1], along[k + 1], limits[k]) for k, e in enumerate(joints)]
    return shapes[0], fingers


def _limits(reader: UrdfReader, joints: Sequence[ElementTree.Element]) -> list[tuple[float, float]]:
    """Return the limits of both joints [m]; a joint that mimics the other one may have none of its own."""
    found = []
    for e in joints:
        limit = e.find("limit")
        low, high = (number(limit.get(key)) if limit is not None else None for key in ("lower", "upper"))
        found.append((low, high) if low is not None and high is not None and high > low else None)
    known = [pair for pair in found if pair is not None]
    if not known:
        hint = "add lower and upper [m]"
        raise FormatError("has no limits of position.", file=reader.file, field=reader.name(joints[0]), hint=hint)
    return [pair or known[0] for pair in found]


def _assembled(file: Path, name: str, body: Sequence[Shape], fingers: Sequence[_Finger], mass: float) -> HandReading:
    """Build the hand: its frame between the fingers, their inner faces, stroke and spheres."""
    first, second = fingers
    z = np.array([0.0, 0.0, 1.0])
    y = _opening_direction(file, first, second)
    closed, strokes = [], []
    for finger, outwards in ((first, y), (second, -y)):
        sign = float(np.sign(finger.along @ outwards))
        ends = sorted(sign * value for value in finger.limits)
        closed.append(ends[0] * outwards)
        strokes.append(ends[1] - ends[0])
    corners = [finger.vertices() + at for finger, at in zip(fingers, closed, strict=True)]
    inner = float((corners[0] @ y).min()), float((corners[1] @ y).max())
    gap = inner[0] - inner[1]
    if gap < -CONSTANTS.gap:
        hint = "correct the limits of the fingers"
        raise FormatError(f"its closed fingers overlap by {-1e3 * gap:.1f} mm.", file=file, hint=hint)
    x = np.cross(y, z)
    across = np.concatenate(corners) @ x
    middle = (inner[0] + inner[1]) / 2 * y + (across.min() + across.max()) / 2 * x
    low, tip = float(corners[0][:, 2].min()), float(corners[0][:, 2].max())
    T_flange_finger = np.stack([_frame(outwards, z, middle + low * z) for outwards in (y, -y)])
    own = [
        [moved(shape, inverse(T) @ _shift(at - gap / 2 * outwards), 0) for shape in finger.shapes]
        for finger, T, at, outwards in zip(fingers, T_flange_finger, closed, (y, -y), strict=True)
    ]
    shapes = own[0] if _same(own[0], own[1]) else [*own[0], *own[1]]
    finger_covering = cover(shapes, COVER.slack / 2)
    depth = min(CONSTANTS.depth, CONSTANTS.share * (tip - low))
    hand = Hand(
        name,
        T_flange_tcp=_frame(y, z, middle + (tip - depth) * z),
        body=tuple(body),
        T_flange_finger=T_flange_finger,
        finger=(_capsule(shapes),),
        stroke=gap / 2 + min(strokes),
        force=_limit(first.joint, "effort") or CONSTANTS.force,
        speed=_limit(first.joint, "velocity") or CONSTANTS.speed,
        mass=mass or CONSTANTS.mass,
        body_covering=cover(body, COVER.slack) if body else None,
        finger_covering=finger_covering,
    )
    if uncovered(shapes, finger_covering) > 0:
        raise FormatError("its fingers are not contained in spheres.", file=file, hint="simplify their meshes")
    return HandReading(replace(hand, box=_box(hand, shapes)), _notes(first.joint, gap, mass))


def _opening_direction(file: Path, first: _Finger, second: _Finger) -> Array:
    """Return the unit direction (3,) across the z axis in which the first finger opens.

    Raises:
        FormatError: the fingers do not move along one line across the z axis.
    """
    y = np.asarray(first.along)
    if abs(y @ second.along) < CONSTANTS.parallel:
        raise FormatError("its fingers do not move along one line.", file=file, hint="give a parallel gripper")
    if abs(y[2]) > CONSTANTS.upright:
        hint = "turn the first link, so that its z axis points from the flange to the tips"
        raise FormatError("its fingers do not open across the z axis of the first link.", file=file, hint=hint)
    apart = float((first.vertices().mean(0) - second.vertices().mean(0)) @ y)
    if apart < 0 or (apart == 0 and sum(first.limits) < 0):
        y = -y
    across = y * [1.0, 1.0, 0.0]
    return np.asarray(across / np.linalg.norm(across))


def _notes(joint: ElementTree.Element, gap: float, mass: float) -> tuple[str, ...]:
    notes = []
    if gap > CONSTANTS.gap:
        notes.append(f"the closed fingers leave a gap of {1e3 * gap:.1f} mm; they hold nothing narrower")
    if _limit(joint, "effort") is None:
        notes.append(f"the fingers have no effort: {CONSTANTS.force:g} N is assumed")
    if _limit(joint, "velocity") is None:
        notes.append(f"the fingers have no velocity: {CONSTANTS.speed:g} m/s is assumed")
    if not mass:
        notes.append(f"the gripper has no mass: {CONSTANTS.mass:g} kg is assumed")
    return tuple(notes)


def _box(hand: Hand, shapes: Sequence[Shape]) -> HandShape:
    """Measure the boxes around palm and fingers in the frame of the tool, on the corners of the geometry."""
    T_tcp_flange = inverse(hand.T_flange_tcp)
    finger = transform_points(T_tcp_flange @ hand.T_flange_finger[0], _corners(shapes))
    body = transform_points(T_tcp_flange, _corners(hand.body)) if hand.body else finger
    pad = finger[finger[:, 1] < finger[:, 1].min() + COVER.pad_depth]
    return HandShape(
        stroke=2 * hand.stroke,
        width=float(2 * np.abs(finger[:, 0]).max()),
        thickness=float(np.ptp(finger[:, 1])),
        tip=float(finger[:, 2].max()),
        pad=float(pad[:, 2].max()),
        pad_width=float(2 * np.abs(pad[:, 0]).max()),
        palm=float(-body[:, 2].max()) if hand.body else float(-finger[:, 2].min()),
        palm_size=(float(2 * np.abs(body[:, 0]).max()), float(2 * np.abs(body[:, 1]).max())),
        force=hand.force,
    )


def _corners(shapes: Sequence[Shape]) -> Array:
    """Return the corners (V, 3) of shapes [m]."""
    return np.concatenate([shape.triangles().reshape(-1, 3) for shape in shapes])


def _capsule(shapes: Sequence[Shape]) -> Capsule:
    """Return the capsule of a finger in the twin, as wide and long as the finger; its inner face is at y = 0."""
    corners = _corners(shapes)
    low, high = corners.min(0), corners.max(0)
    radius = float(min(high[0] - low[0], high[1] - low[1], high[2] - low[2]) / 2)
    x = float(low[0] + high[0]) / 2
    return Capsule(0, (x, radius, float(low[2]) + radius), (x, radius, float(high[2]) - radius), radius)


def _same(a: Sequence[Shape], b: Sequence[Shape]) -> bool:
    """Return whether two fingers have the same corners."""
    ours, theirs = _corners(a), _corners(b)
    far = max(cKDTree(ours).query(theirs)[0].max(), cKDTree(theirs).query(ours)[0].max())
    return bool(far <= CONSTANTS.same)


def _mass(reader: UrdfReader) -> float:
    """Return the sum of all masses [kg]."""
    masses = [e.get("value") for link in reader.links.values() for e in link.findall("inertial/mass")]
    return sum(number(mass) or 0.0 for mass in masses)


def _limit(joint: ElementTree.Element, key: str) -> float | None:
    """Return a positive limit of a joint, or None."""
    limit = joint.find("limit")
    value = number(limit.get(key)) if limit is not None else None
    return value if value is not None and value > 0 else None


def _frame(y: Array, z: Array, at: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T[:3, 3] = at
    return T


def _shift(by: Array) -> Array:
    T = np.eye(4)
    T[:3, 3] = by
    return T
