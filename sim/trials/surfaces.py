"""The objects of a twin's scene as textured meshes for a simulated camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.logs.raycast import RaycastSurface
from splatbot.logs.shapes import TriangleMesh, box, cylinder, sphere
from splatbot.logs.textures import Texture
from splatbot.sim.scene import SceneObject
from splatbot.sim.solids import BoxGeom, CapsuleGeom, CylinderGeom, EllipsoidGeom, MeshGeom, Shape, SphereGeom, pose_at
from splatbot.sim.wrist import capsule_mesh


@dataclass(frozen=True)
class SurfaceTwinConstants:
    """Constants of the pattern of trial surfaces.

    Args:
        dark: brightness of the second colour relative to the first.
        period: [m] period of the pattern.
    """

    dark: float = 0.7
    period: float = 0.03


CONSTANTS = SurfaceTwinConstants()


def surfaces_of(obj: SceneObject, *, placed: bool = True, seed: int = 0) -> list[RaycastSurface]:
    """Convert an object's shapes to meshes with a pattern in its colour, in the scene's frame or in its own.

    Raises:
        InputError: a shape has no mesh here: planes, mesh files and soft bodies.
    """
    r, g, b = obj.color
    texture = Texture(
        (r, g, b), (CONSTANTS.dark * r, CONSTANTS.dark * g, CONSTANTS.dark * b), CONSTANTS.period, seed=seed
    )
    T = pose_at(obj.at, obj.rpy) if placed else np.eye(4)
    found = []
    for shape in obj.shapes:
        mesh = mesh_of(shape, obj.name)
        vertices = transform_points(T @ pose_at(shape.at, shape.rpy), mesh.vertices)
        found.append(RaycastSurface(TriangleMesh(vertices, mesh.triangles), texture))
    return found


def mesh_of(shape: Shape, name: str) -> TriangleMesh:
    """Convert a shape of the object ``name`` to a mesh in the shape's own frame.

    Raises:
        InputError: the shape is a plane, a mesh file or a soft body.
    """
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
    if isinstance(shape, MeshGeom) and shape.points:
        points = shape.scale * np.asarray(shape.points, dtype=np.float64)
        hull = ConvexHull(points)
        corners = hull.vertices
        rows = np.full(len(points), -1)
        rows[corners] = np.arange(len(corners))
        return TriangleMesh(points[corners], rows[hull.simplices].astype(np.uint32))
    hint = "give boxes, cylinders, spheres, ellipsoids, capsules or hulls of points"
    raise InputError(f"is a {shape.kind}.", field=name, hint=hint)
