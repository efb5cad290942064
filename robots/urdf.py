"""Reader of an arm from a URDF file."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from xml.parsers.expat import ExpatError, ParserCreate

import numpy as np

from splatbot.errors import FormatError, InputError
from splatbot.geometry import inverse, so3_exp, transform_points
from splatbot.protocols import Array
from splatbot.robots.joints import Joint
from splatbot.robots.link_frames import LinkFrames
from splatbot.robots.maker_meshes import read_shapes
from splatbot.robots.reading import CONSTANTS, NamedShape, Reading, checked_slack, default_tip, distinct, joint, z_to
from splatbot.robots.robot import Inertial, RobotModel
from splatbot.robots.shapes import Box, Capsule, Shape

MOVING = ("revolute", "continuous", "prismatic")
"""Types of joints that move."""


GEOMETRY = ("collision", "visual")
"""Kinds of geometry of a link."""


def read_urdf(
    path: str | Path, *, tip: str | None = None, slack: float | None = None, kinds: Sequence[str] = GEOMETRY
) -> Reading:
    """Read the serial arm from the root to ``tip``.

    Fixed links belong to the link of the arm that carries them. Moving joints outside the arm (fingers) are fixed at
    the value in their limits that is nearest to 0. The shapes of a link are its collision and its visual geometry.

    Args:
        path: URDF file, or a xacro file if the package xacro is installed.
        tip: last link of the arm. If None, see :func:`splatbot.robots.reading.default_tip`.
        slack: see :class:`splatbot.robots.robot.RobotModel` [m]. If None, 2 % of the reach.
        kinds: geometry that becomes shapes.

    Raises:
        FormatError: the file is no URDF, has no moving joint, or contains an invalid element, which the error names.
    """
    file = Path(path)
    root = parse(file)
    if root.tag != "robot":
        hint = "give a URDF, xacro or MJCF file, whose root is <robot> or <mujoco>"
        raise FormatError(f"its root is <{root.tag}>.", file=file, hint=hint)
    return UrdfReader(file, root, slack, kinds).read(tip)


def parse(file: Path) -> ElementTree.Element:
    """Parse an XML file, and expand the macros of xacro.

    Prefixes of namespaces need no declaration, as in ROS (``drake:acceleration`` in files of Drake's users).

    Raises:
        FormatError: the file cannot be read, is no XML, or has macros that cannot be expanded.
    """
    try:
        text = file.read_bytes()
        root = _elements(text)
    except (OSError, ExpatError) as error:
        hint = "give a URDF, xacro or MJCF file"
        raise FormatError(f"cannot be read ({error}).", file=file, hint=hint) from error
    return _expanded(file) if b"/xacro" in text else root


def _elements(text: bytes) -> ElementTree.Element:
    """Parse XML; names keep their prefixes as they stand."""
    builder, parser = ElementTree.TreeBuilder(), ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(text, True)
    return builder.close()


def _expanded(file: Path) -> ElementTree.Element:
    try:
        import xacro  # type: ignore[import-untyped]
    except ImportError as error:
        hint = f"pip install xacro, or expand it: xacro {file.name} > robot.urdf"
        raise FormatError("has macros of xacro.", file=file, hint=hint) from error
    try:
        return ElementTree.fromstring(xacro.process_file(str(file)).toxml())
    except Exception as error:  # xacro raises its own errors, those of expressions, and those of ROS packages
        hint = f"expand it where its ROS packages are: xacro {file.name} > robot.urdf"
        raise FormatError(f"cannot be expanded ({error}).", file=file, hint=hint) from error


class UrdfReader:
    """Links and joints of a URDF.

    Args:
        file: for errors, and for the paths of meshes.
        root: element of the robot.
        slack: see :class:`splatbot.robots.robot.RobotModel` [m].
        kinds: geometry that becomes shapes.
    """

    def __init__(
        self, file: Path, root: ElementTree.Element, slack: float | None = None, kinds: Sequence[str] = GEOMETRY
    ) -> None:
        self.file, self.root, self.slack, self.kinds = file, root, slack, kinds
        self.links = {self.name(e): e for e in root.findall("link")}
        self.joint_to = {self.link(e, "child"): e for e in root.findall("joint")}
        self.notes: list[str] = []

    def read(self, tip: str | None) -> Reading:
        if tip is not None and tip not in self.links:
            raise FormatError(f"there is no link {tip!r}.", file=self.file, hint=f"links: {', '.join(self.links)}")
        end = tip or self._default_tip()
        arm = [e for e in self._path(end) if e.get("type") in MOVING]
        if not arm:
            raise FormatError("has no moving joint.", file=self.file, field=end, hint="name another link with tip")
        joints: list[Joint] = []
        turns: list[Array] = []
        placed: dict[str, tuple[int, Array]] = {self.root_link(): (0, np.eye(4))}
        for child, e in self.outwards():
            k, T = placed[self.link(e, "parent")]
            T = T @ origin(e)
            if e not in arm:
                placed[child] = (k, T @ self._fixed(e))
                continue
            turn = np.eye(4)
            turn[:3, :3] = z_to(self.axis(e))
            joints.append(self._joint(e, T @ turn))
            turns.append(turn)
            placed[child] = (k + 1, turn.T)
        shapes = distinct(shape for link, (k, T) in placed.items() for shape in self.shapes(link, k, T))
        slack = checked_slack(shapes, joints, placed[end][1], self.slack, self.file)
        base = self.link(arm[0], "parent")
        lower, upper = np.array([j.lower for j in joints]), np.array([j.upper for j in joints])
        robot = RobotModel(
            name=self.root.get("name") or self.file.stem,
            joints=tuple(joints),
            shapes=tuple(named.shape for named in shapes),
            T_link_tcp=placed[end][1],
            home=np.clip(np.zeros(len(joints)), lower, upper),
            inertials=self._inertials(len(joints), placed),
            slack=slack,
            link_frames=LinkFrames(
                (base, *(self.link(e, "child") for e in arm)), np.stack([inverse(placed[base][1]), *turns])
            ),
        )
        return Reading(robot, tuple(self.notes))

    def root_link(self) -> str:
        """Return the link that no joint moves.

        Raises:
            FormatError: there is not exactly one.
        """
        roots = [link for link in self.links if link not in self.joint_to]
        if len(roots) != 1:
            raise FormatError(f"has {len(roots)} root links.", file=self.file, hint="a URDF has one")
        return roots[0]

    def outwards(self) -> Iterator[tuple[str, ElementTree.Element]]:
        """Yield each link with the joint to it, parents before their children.

        Raises:
            FormatError: links form a circle.
        """
        placed, left = {self.root_link()}, dict(self.joint_to)
        while ready := [child for child, joint in left.items() if self.link(joint, "parent") in placed]:
            for child in ready:
                placed.add(child)
                yield child, left.pop(child)
        if left:
            raise FormatError("has links in a circle.", file=self.file, field=next(iter(left)), hint="a URDF is a tree")

    def _path(self, link: str) -> list[ElementTree.Element]:
        found: list[ElementTree.Element] = []
        while link in self.joint_to and len(found) <= len(self.joint_to):
            found.append(self.joint_to[link])
            link = self.link(found[-1], "parent")
        return found[::-1]

    def _default_tip(self) -> str:
        carried: dict[str, list[str]] = {}
        for child, e in self.joint_to.items():
            carried.setdefault(self.link(e, "parent"), []).append(child)
        moving = [child for child, e in self.joint_to.items() if e.get("type") in MOVING]
        root = next((link for link in self.links if link not in self.joint_to), "")
        return default_tip(carried, moving, root, self.file)

    def _joint(self, e: ElementTree.Element, T: Array) -> Joint:
        name, limit = self.name(e), e.find("limit")
        values = {key: number(limit.get(key)) if limit is not None else None for key in ("velocity", "effort")}
        low, high = (number(limit.get(key)) if limit is not None else None for key in ("lower", "upper"))
        if e.get("type") == "continuous":
            low, high = -2 * np.pi, 2 * np.pi
            self.notes.append(f"{name} turns without end: limited to two turns")
        if low is None or high is None:
            raise FormatError("has no limits of position.", file=self.file, field=name, hint="add lower and upper")
        velocity = values["velocity"] or 0.0
        if velocity <= 0:
            velocity = CONSTANTS.velocity
            self.notes.append(f"{name} has no limit of velocity: {CONSTANTS.velocity:g} per second is assumed")
        try:
            prismatic = e.get("type") == "prismatic"
            return joint(name, T, (low, high), velocity, values["effort"] or 0.0, prismatic=prismatic)
        except InputError as error:
            raise FormatError(error.message, file=self.file, field=name, hint=error.hint) from error

    def _fixed(self, e: ElementTree.Element) -> Array:
        """Return the transform (4, 4) of a joint outside the arm."""
        T = np.eye(4)
        if e.get("type") not in MOVING:
            return T
        limit = e.find("limit")
        low, high = (number(limit.get(key)) if limit is not None else None for key in ("lower", "upper"))
        at = float(np.clip(0.0, low if low is not None else -np.inf, high if high is not None else np.inf))
        self.notes.append(f"{self.name(e)} is not on the arm: held at {at:g}")
        if e.get("type") == "prismatic":
            T[:3, 3] = at * self.axis(e)
        else:
            T[:3, :3] = so3_exp(at * self.axis(e))
        return T

    def axis(self, e: ElementTree.Element) -> Array:
        """Return the unit axis (3,) of a joint in its own frame."""
        found = e.find("axis")
        axis = _vector(found.get("xyz") if found is not None else None, (1.0, 0.0, 0.0))
        if not np.linalg.norm(axis) > 0:
            raise FormatError("has an axis of no length.", file=self.file, field=self.name(e), hint="give a direction")
        return np.asarray(axis / np.linalg.norm(axis))

    def shapes(self, link: str, k: int, T: Array) -> list[NamedShape]:
        """Return the collision and the visual geometry of a link; the same geometry in both counts once."""
        found: dict[str, list[NamedShape]] = {}
        for kind in self.kinds:
            for e in self.links[link].findall(kind):
                key = " ".join(str(part.attrib) for part in e.iter() if part.tag not in (kind, "material", "color"))
                try:
                    found.setdefault(key, self._shape(e, link, k, T @ origin(e)))
                except FormatError as error:
                    if kind == "collision" or not self.links[link].findall("collision"):
                        raise
                    self.notes.append(f"{link}: its visual geometry is not covered ({error.message} {error.hint})")
        return [shape for shapes in found.values() for shape in shapes]

    def _shape(self, e: ElementTree.Element, link: str, k: int, T: Array) -> list[NamedShape]:
        kind = next(iter(e.find("geometry") or []), None)
        if kind is None:
            raise FormatError("has no geometry.", file=self.file, field=link, hint="remove the element, or fill it")
        if kind.tag == "sphere":
            at = (float(T[0, 3]), float(T[1, 3]), float(T[2, 3]))
            return [NamedShape(link, Capsule(k, at, at, self._size(kind, "radius", link)))]
        if kind.tag == "cylinder":
            cylinder = _cylinder(k, T, self._size(kind, "radius", link), self._size(kind, "length", link))
            return [NamedShape(link, cylinder)]
        if kind.tag == "box":
            x, y, z = _vector(kind.get("size"), (0.0, 0.0, 0.0))
            return [NamedShape(link, Box(k, T, (float(x), float(y), float(z))))]
        if kind.tag == "mesh":
            return self._mesh(kind, link, k, T)
        raise FormatError(
            f"has a <{kind.tag}>.", file=self.file, field=link, hint="use spheres, cylinders, boxes, meshes"
        )

    def _mesh(self, e: ElementTree.Element, link: str, k: int, T: Array) -> list[NamedShape]:
        path = self._resolve(e.get("filename") or "", link)
        try:
            meshes = read_shapes(path, k, _vector(e.get("scale"), (1.0, 1.0, 1.0)))
        except InputError as error:
            raise FormatError(error.message, file=path, field=link, hint=error.hint) from error
        moved = [replace(mesh, vertices=transform_points(T, mesh.vertices)) for mesh in meshes]
        return [NamedShape(f"{link} ({path.name})", mesh) for mesh in moved]

    def _resolve(self, name: str, link: str) -> Path:
        """Find a mesh relative to the URDF, or in the folder of its package:// above the URDF."""
        if not name.startswith("package://"):
            found = (self.file.parent / name.removeprefix("file://")).resolve()
        else:
            package, _, rest = name.removeprefix("package://").partition("/")
            above = [folder for folder in self.file.resolve().parents if folder.name == package]
            siblings = [folder / package for folder in self.file.resolve().parents if (folder / package).is_dir()]
            folders = (*above, *siblings, *self.file.resolve().parents)  # for packages in renamed folders
            found = next((f / rest for f in folders if (f / rest).exists()), Path(name))
        if not found.exists():
            raise FormatError(
                f"{name} is not there.", file=self.file, field=link, hint="keep the meshes next to the file"
            )
        return found

    def _inertials(self, joints: int, placed: dict[str, tuple[int, Array]]) -> tuple[Inertial, ...]:
        """Sum the inertias of each link of the arm and its fixed links; empty if a moving link has no mass."""
        parts: list[list[tuple[float, Array, Array]]] = [[] for _ in range(joints + 1)]
        for link, (k, T_link) in placed.items():
            e = self.links[link].find("inertial")
            m = number(e.find("mass").get("value")) if e is not None and e.find("mass") is not None else None  # type: ignore[union-attr]
            if e is None or not m:
                continue
            T, values = T_link @ origin(e), e.find("inertia")
            ixx, iyy, izz, ixy, ixz, iyz = (
                float(values.get(key, "0")) if values is not None else 0.0
                for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            )
            own = T[:3, :3] @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]) @ T[:3, :3].T
            parts[k].append((m, T[:3, 3], own))
        if any(sum(m for m, _, _ in own) <= 0 for own in parts[1:]):
            self.notes.append("some moving links have no mass: the twin cannot be built from it")
            return ()
        return tuple(Inertial.summed(own) for own in parts)

    def _size(self, e: ElementTree.Element, key: str, link: str) -> float:
        value = number(e.get(key))
        if value is None or not value > 0:
            raise FormatError(
                f"<{e.tag}> has {key} {e.get(key)!r}.", file=self.file, field=link, hint="give metres above 0"
            )
        return value

    def name(self, e: ElementTree.Element) -> str:
        """Return the name of an element."""
        name = e.get("name")
        if not name:
            raise FormatError(f"a <{e.tag}> has no name.", file=self.file, hint="name it")
        return name

    def link(self, joint: ElementTree.Element, end: str) -> str:
        """Return the link at an end of a joint, which is "parent" or "child"."""
        e = joint.find(end)
        name = e.get("link") if e is not None else None
        if name is None or name not in self.links:
            raise FormatError(f"its {end} is {name!r}.", file=self.file, field=self.name(joint), hint="name a link")
        return name


def _cylinder(k: int, T: Array, radius: float, length: float) -> Shape:
    """Return a capsule with the cylinder's axis, or the enclosing box if the cylinder is not longer than wide."""
    ends = transform_points(T, np.array([[0, 0, -length / 2], [0, 0, length / 2]]))
    start, end = ends
    if length <= 2 * radius:
        return Box(k, T, (2 * radius, 2 * radius, length))
    return Capsule(k, (start[0], start[1], start[2]), (end[0], end[1], end[2]), radius)


def origin(e: ElementTree.Element) -> Array:
    """Return the pose (4, 4) of an element: fixed-axis roll, pitch, yaw."""
    found = e.find("origin")
    T = np.eye(4)
    if found is not None:
        roll, pitch, yaw = _vector(found.get("rpy"), (0.0, 0.0, 0.0))
        T[:3, :3] = so3_exp([0, 0, yaw]) @ so3_exp([0, pitch, 0]) @ so3_exp([roll, 0, 0])
        T[:3, 3] = _vector(found.get("xyz"), (0.0, 0.0, 0.0))
    return T


def _vector(text: str | None, default: Sequence[float]) -> Array:
    if text is None:
        return np.asarray(default, dtype=np.float64)
    values = [number(word) for word in text.split()]
    if len(values) != 3 or any(v is None for v in values):
        raise FormatError(f"is {text!r}.", field="xyz, rpy, size or scale", hint="give three numbers")
    return np.array(values, dtype=np.float64)


def number(text: str | None) -> float | None:
    """Return a finite number, or None."""
    try:
        value = float(text) if text is not None else None
    except ValueError:
        return None
    return value if value is not None and np.isfinite(value) else None
