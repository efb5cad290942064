"""The objects of a twin's scene as textured meshes, for a camera that looks at them."""

from __future__ import annotations

import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.logs.raycast import RaycastSurface
from splatbot.logs.shapes import TriangleMesh, box, cylinder, sphere
from splatbot.logs.textures import Texture
from splatbot.sim.scene import SceneObject
from splatbot.sim.solids import BoxGeom, CapsuleGeom, CylinderGeom, EllipsoidGeom, Shape, SphereGeom, pose_at
from splatbot.sim.wrist import capsule_mesh

_DARK = 0.7  # of the second colour
_PERIOD = 0.03  # [m] of the pattern


def surfaces_of(thing: SceneObject, *, placed: bool = True, seed: int = 0) -> list[RaycastSurface]:
    """Meshes of an object's shapes, where the scene puts it, or in its own frame; mottled in its colour.

    Raises:
        InputError: a shape has no mesh here: planes, hulls and soft bodies.
    """
    r, g, b = thing.color
    texture = Texture((r, g, b), (_DARK * r, _DARK * g, _DARK * b), _PERIOD, seed=seed)
    T = pose_at(thing.at, thing.rpy) if placed else np.eye(4)
    found = []
    for shape in thing.shapes:
        mesh = _mesh(shape, thing.name)
        vertices = transform_points(T @ pose_at(shape.at, shape.rpy), mesh.vertices)
        found.append(RaycastSurface(TriangleMesh(vertices, mesh.triangles), texture))
    return found


def _mesh(shape: Shape, name: str) -> TriangleMesh:
    """About the shape's middle."""
    if isinstance(shape, BoxGeom):
        return box(shape.size).placed([0.0, 0.0, -shape.size[2] / 2])
    if isinstance(shape, CylinderGeom):
        return cylinder(shape.radius, shape.height).placed([0.0, 0.0, -shape.height / 2])
    if isinstance(shape, SphereGeom):
        return sphere(shape.radius).placed([0.0, 0.0, -shape.radius])
    if isinstance(shape, EllipsoidGeom):
        ball = sphere(1.0).placed([0.0, 0.0, -1.0])
        return TriangleMesh(ball.vertices * np.asarray(shape.axes), ball.triangles)
    if isinstance(shape, CapsuleGeom):
        return capsule_mesh([0.0, 0.0, -shape.height / 2], [0.0, 0.0, shape.height / 2], shape.radius)
    raise InputError(f"is a {shape.kind}.", field=name, hint="give boxes, cylinders, balls, ellipsoids or capsules")
