"""Objects that MoveIt attaches to links of a robot, as spheres that cover them."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import pose_from_quat, transform_points
from splatbot.logs.ros_types import Message
from splatbot.protocols import Array
from splatbot.robots.tf_buffer import TransformBuffer

MAX_SOLIDS = 64
"""Largest number of shapes of an attached object."""
MAX_SIZE = 5.0
"""Largest length [m] of a shape, and its largest distance from its link along an axis."""
MAX_VERTICES = 100_000

_ADD, _REMOVE, _APPEND = 0, 1, 2  # of moveit_msgs/CollisionObject
_BOX, _SPHERE, _CYLINDER, _CONE = 1, 2, 3, 4  # of shape_msgs/SolidPrimitive
_THINNEST = 1e-6  # [m] of the bounding box of a flat mesh
_KNOWN = "attach boxes, spheres, cylinders, cones or meshes"
_DIMENSIONS = {_BOX: 3, _SPHERE: 1, _CYLINDER: 2, _CONE: 2}

Shape = Literal["box", "sphere", "cylinder", "cone"]


@dataclass(frozen=True, eq=False)
class AttachedSolid:
    """A shape on a link. The axis of a cylinder or cone is z, and the tip of a cone is at +z.

    Args:
        shape: kind of the shape.
        size: (3,) lengths of its bounding box, whose centre is the origin [m].
        T_link_solid: (4, 4) its pose on the link [m].
    """

    shape: Shape
    size: Array
    T_link_solid: Array

    def spheres(self, most: int) -> Array:
        """Cover the shape by at most ``most`` spheres (N, 4) (x, y, z, radius) [m] in the frame of the link.

        The bounding box is divided into equal cells, as close to cubes as their number allows. Each cell that meets
        the shape has its circumscribed sphere.
        """
        if self.shape == "sphere":
            return np.array([[*self.T_link_solid[:3, 3], self.size[0] / 2]])
        counts = _cells(self.size, most)
        cell = self.size / counts
        axes = [(np.arange(n) - (n - 1) / 2) * step for n, step in zip(counts, cell, strict=True)]
        centers = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        if self.shape != "box":
            nearest = np.linalg.norm(np.maximum(np.abs(centers[:, :2]) - cell[:2] / 2, 0.0), axis=1)
            centers = centers[nearest <= self._radius(centers[:, 2] - cell[2] / 2)]
        radius = np.full(len(centers), np.linalg.norm(cell) / 2)
        return np.c_[transform_points(self.T_link_solid, centers), radius]

    def _radius(self, z: Array) -> Array:
        """Return the largest radius (N,) [m] of a cylinder or cone at a height z (N,) [m] or above it."""
        radius = self.size[0] / 2
        return np.full(len(z), radius) if self.shape == "cylinder" else radius * (0.5 - z / self.size[2])


def _cells(size: Array, most: int) -> Array:
    """Return the numbers (3,) of cells along each axis: the finest division in cubes of at most ``most`` cells."""
    for along in range(most, 1, -1):
        counts = np.maximum(np.ceil(size * along / size.max() - 1e-9), 1.0)
        if counts.prod() <= most:
            return counts
    return np.ones(3)


@dataclass(frozen=True, eq=False)
class AttachedObject:
    """An object in the frame of the link that carries it."""

    link: str
    solids: tuple[AttachedSolid, ...]


class AttachedObjects:
    """The objects that are attached now; any thread changes them, and mapping reads them.

    Args:
        transforms: places objects whose poses are not in the frame of their link.
    """

    def __init__(self, transforms: TransformBuffer) -> None:
        self._transforms = transforms
        self._objects: dict[str, AttachedObject] = {}
        self._lock = threading.Lock()
        self.version = 0

    @property
    def objects(self) -> dict[str, AttachedObject]:
        """Objects by their names."""
        with self._lock:
            return dict(self._objects)

    def take_object(self, message: Message) -> None:
        """Apply a moveit_msgs/AttachedCollisionObject.

        Raises:
            InputError: the object cannot be covered or placed; those that are attached remain.
        """
        self._change(self._applied(self.objects, message))

    def take_scene(self, message: Message) -> None:
        """Apply the robot state of a moveit_msgs/PlanningScene. A scene that is no difference replaces all objects.

        Raises:
            InputError: an object cannot be covered or placed; the others of the scene are applied.
        """
        objects = self.objects if message.is_diff or message.robot_state.is_diff else {}
        problem = None
        for one in message.robot_state.attached_collision_objects:
            try:
                objects = self._applied(objects, one)
            except InputError as error:
                problem = error
        self._change(objects)
        if problem is not None:
            raise problem

    def _change(self, objects: dict[str, AttachedObject]) -> None:
        with self._lock:
            if objects or self._objects:
                self._objects, self.version = objects, self.version + 1

    def _applied(self, objects: dict[str, AttachedObject], message: Message) -> dict[str, AttachedObject]:
        """Return the objects after a moveit_msgs/AttachedCollisionObject."""
        name, link = str(message.object.id), message.link_name.strip("/")
        if message.object.operation == _REMOVE:  # without a name all objects of the link, without both all of them
            kept = {known: one for known, one in objects.items() if link not in ("", one.link)}
            return {known: one for known, one in objects.items() if known != name} if name else kept
        try:
            return objects | {name: self._attached(objects.get(name), message.object, name, link)}
        except InputError as error:
            where = f"attached object {name[:40]!r}"
            raise InputError(error.message, file=where, field=error.field, hint=error.hint) from error

    def _attached(self, known: AttachedObject | None, message: Message, name: str, link: str) -> AttachedObject:
        if message.operation not in (_ADD, _APPEND):
            hint = "send ADD, REMOVE or APPEND"
            raise InputError(f"is {message.operation}.", field="operation", hint=hint)
        if not name or not link:
            raise InputError("is empty.", field="id, link_name", hint="name the object and its link")
        solids = self._solids(message, link)
        if message.operation == _APPEND and known is not None:
            if known.link != link:
                hint = f"send ADD, or append to {known.link}"
                raise InputError(f"is {link}.", field="link_name", hint=hint)
            solids = (*known.solids, *solids)
        if len(solids) > MAX_SOLIDS:
            raise InputError(f"are {len(solids)}.", field="shapes", hint=f"attach at most {MAX_SOLIDS}")
        return AttachedObject(link, solids)

    def _solids(self, message: Message, link: str) -> tuple[AttachedSolid, ...]:
        """Return the shapes of a moveit_msgs/CollisionObject on a link."""
        if len(message.planes):
            raise InputError("are infinite.", field="planes", hint=_KNOWN)
        if not len(message.primitives) and not len(message.meshes):
            hint = "send the shapes too, or forward /monitored_planning_scene"
            raise InputError("are empty.", field="primitives", hint=hint)
        T_link_object = self._frame(link, message.header.frame_id.strip("/")) @ _pose(message.pose)
        shapes = [*map(_primitive, message.primitives), *map(_mesh, message.meshes)]
        poses = _poses(message.primitive_poses, len(message.primitives)) + _poses(
            message.mesh_poses, len(message.meshes)
        )
        solids = tuple(
            replace(shape, T_link_solid=T_link_object @ T @ shape.T_link_solid)
            for shape, T in zip(shapes, poses, strict=True)
        )
        if not all(np.abs(one.T_link_solid[:3, 3]).max() <= MAX_SIZE for one in solids):
            raise InputError(f"is more than {MAX_SIZE:g} m from its link.", field="pose", hint="give metres")
        return solids

    def _frame(self, link: str, frame: str) -> Array:
        """Return T_link_frame (4, 4) of the frame that the poses of an object are in."""
        T = np.eye(4) if frame in ("", link) else self._transforms.newest(link, frame)
        if T is None:
            hint = f"give poses in {link}, or publish the transforms between them"
            raise InputError(f"is {frame}, which TF does not connect with {link}.", field="frame_id", hint=hint)
        return T


def _primitive(message: Message) -> AttachedSolid:
    kind, given = int(message.type), np.asarray(message.dimensions, np.float64)
    if kind not in _DIMENSIONS:
        raise InputError(f"has the type {kind}.", field="primitives", hint=_KNOWN)
    if len(given) != _DIMENSIONS[kind] or not (given > 0).all() or not given.max() <= MAX_SIZE:
        hint = f"give {_DIMENSIONS[kind]} lengths in metres, at most {MAX_SIZE:g}"
        raise InputError(f"is {given[:4].tolist()}.", field="dimensions", hint=hint)
    if kind == _BOX:
        return AttachedSolid("box", given, np.eye(4))
    if kind == _SPHERE:
        return AttachedSolid("sphere", np.repeat(2 * given, 3), np.eye(4))
    height, radius = given
    size = np.array([2 * radius, 2 * radius, height])
    return AttachedSolid("cylinder" if kind == _CYLINDER else "cone", size, np.eye(4))


def _mesh(message: Message) -> AttachedSolid:
    """Return the bounding box of a mesh."""
    if not 0 < len(message.vertices) <= MAX_VERTICES:
        hint = f"send 1 to {MAX_VERTICES}, or a box"
        raise InputError(f"are {len(message.vertices)}.", field="vertices", hint=hint)
    vertices = np.array([(v.x, v.y, v.z) for v in message.vertices])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if not (high - low).max() <= MAX_SIZE:
        raise InputError("are not finite or too far.", field="vertices", hint=f"give metres, at most {MAX_SIZE:g}")
    T = np.eye(4)
    T[:3, 3] = (low + high) / 2
    return AttachedSolid("box", np.maximum(high - low, _THINNEST), T)


def _poses(poses: Sequence[Message], count: int) -> list[Array]:
    """Return the poses (4, 4) of shapes in the frame of their object; missing ones are its own."""
    return [_pose(poses[k]) if k < len(poses) else np.eye(4) for k in range(count)]


def _pose(message: Message) -> Array:
    """Return a geometry_msgs/Pose (4, 4) [m]; the quaternion of an empty message is no rotation."""
    p, q = message.position, message.orientation
    quat = np.array([q.w, q.x, q.y, q.z])
    if not np.isfinite([p.x, p.y, p.z, *quat]).all():
        raise InputError("is not finite.", field="pose", hint="give metres and a unit quaternion")
    return pose_from_quat((p.x, p.y, p.z), quat if quat.any() else (1.0, 0.0, 0.0, 0.0))
