"""Peers of the collision field: brute force in torch, coal, python-fcl, Open3D, and VAMP if it is installed."""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
import torch

from splatbot.bench.benchmark import ReportProgress
from splatbot.bench.results import Results
from splatbot.bench.tabletop import Ball, Block, Can, Tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.fcl_models import fcl_mesh, fcl_octree
from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_to_rotation
from splatbot.logs.shapes import TriangleMesh, box, cylinder, sphere
from splatbot.protocols import Array


@dataclass(frozen=True)
class CollisionPeerConstants:
    """Constants of the peers of collision queries.

    Args:
        octree_voxel: [m] voxel size of the octree.
        chunk: points per batch against all Gaussians: 60 MB with 100,000 Gaussians.
    """

    octree_voxel: float = 0.01
    chunk: int = 50


CONSTANTS = CollisionPeerConstants()


def run_brute_force(results: Results, model: GaussianModel, points: Array, report_progress: ReportProgress) -> None:
    """Evaluate d² = (p - μ)ᵀ Σ⁻¹ (p - μ) for all pairs by einsum in float32, batch by batch."""
    case = f"points against {len(model)} Gaussians"
    field = GaussianCollisionField(model)
    ours_hit = _least_seconds(lambda: field.in_collision(points))
    ours_distance = _least_seconds(lambda: field.mahalanobis(points))
    results.add(case, "boolean", 1e3 * ours_hit, "ms")
    results.add(case, "smallest Mahalanobis distance", 1e3 * ours_distance, "ms")
    report_progress(f"{case}: torch")
    scales = model.scales.double().clamp_min(5e-5)
    R = torch.from_numpy(quat_to_rotation(model.quats.numpy()))
    inverse = torch.einsum("nij,nj,nkj->nik", R, scales**-2, R)
    start = time.perf_counter()
    squared = _torch_squared(model.means, inverse.float(), torch.from_numpy(points).float())
    theirs = time.perf_counter() - start
    for metric, ours in (("boolean", ours_hit), ("smallest Mahalanobis distance", ours_distance)):
        results.add(case, metric, 1e3 * theirs, "ms", peer="torch")
        results.add(case, f"{metric}, ratio to splatbot", theirs / ours, "x", peer="torch")
    some = points[:: max(1, len(points) // 1000)]
    exact = _torch_squared(model.means.double(), inverse, torch.from_numpy(some)).clamp_min(0).sqrt().numpy()
    found = field.mahalanobis(some).distance
    results.add(case, "largest relative difference from float64", float((np.abs(found - exact) / exact).max()), "")
    packed = squared[:: max(1, len(points) // 1000)].clamp_min(0).sqrt().numpy()
    difference = float((np.abs(packed - exact) / exact).max())
    results.add(case, "largest relative difference from float64", difference, "", peer="torch")
    wrong = int((field.in_collision(some) != (exact <= field.n_sigma)).sum())
    results.add(case, "verdicts that differ from float64's", float(wrong), "points")


def _torch_squared(means: torch.Tensor, inverse: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    least = []
    for part in points.split(CONSTANTS.chunk):
        x = part[:, None] - means[None]
        least.append(torch.einsum("pni,nij,pnj->pn", x, inverse, x).min(dim=1).values)
    return torch.cat(least)


def run_mesh_peers(
    results: Results, scene: Tabletop, arm: RobotSpheres, q: Array, report_progress: ReportProgress
) -> None:
    """Check the same spheres against a mesh of the true shapes and an octree of their points, through Python."""
    vertices, triangles = mesh_of(scene)
    case = f"configurations, {len(arm.spheres)} spheres, against {len(triangles)} triangles"
    moving = arm.spheres.link > 0
    centers, radii = arm.centers(q)[:, moving], arm.spheres.radii[moving]
    for name, make in (
        ("coal BVH", _coal_mesh),
        ("coal octree 1 cm", _coal_octree),
        ("python-fcl BVH", _fcl_mesh),
        ("python-fcl octree 1 cm", _fcl_octree),
        ("Open3D distance", _open3d),
    ):
        report_progress(f"{case}: {name}")
        try:
            start = time.perf_counter()
            check = make(vertices, triangles, scene)
            built = time.perf_counter() - start
        except (ImportError, AttributeError) as error:
            results.add(case, "configurations a second", None, "1/s", peer=name, note=f"absent: {error}")
            continue
        start = time.perf_counter()
        hits = check(centers, radii)
        spent = time.perf_counter() - start
        results.add(case, "build", 1e3 * built, "ms", peer=name)
        results.add(case, "configurations a second", len(q) / spent, "1/s", peer=name)
        results.add(case, "share in collision", 100.0 * float(np.mean(hits)), "%", peer=name)
    report_progress(f"{case}: VAMP")
    _run_vamp(results, case, scene, q)


SphereCheck = Callable[[Array, Array], list[bool]]


def _coal_mesh(vertices: Array, triangles: Array, scene: Tabletop) -> SphereCheck:
    coal = importlib.import_module("coal")
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(triangles), len(vertices))
    model.addVertices(vertices)
    model.addTriangles(triangles.astype(np.int32))
    model.endModel()
    return _coal_spheres(coal, model)


def _coal_octree(vertices: Array, triangles: Array, scene: Tabletop) -> SphereCheck:
    coal = importlib.import_module("coal")
    return _coal_spheres(coal, coal.makeOctree(_points_of(scene), CONSTANTS.octree_voxel))


def mesh_checker(scene: Tabletop) -> SphereCheck:
    """Return coal's check of spheres (C, S, 3) with radii (S,) [m] against the mesh of the shapes."""
    return _coal_mesh(*mesh_of(scene), scene)


def octree_checker(scene: Tabletop) -> SphereCheck:
    """Return coal's check of spheres (C, S, 3) with radii (S,) [m] against an octree of points on the shapes."""
    return _coal_octree(*mesh_of(scene), scene)


def _coal_spheres(coal: Any, world: Any) -> SphereCheck:
    request, fixed = coal.CollisionRequest(), coal.Transform3s()

    def check(centers: Array, radii: Array) -> list[bool]:
        balls = [coal.Sphere(float(r)) for r in radii]
        poses = [coal.Transform3s() for _ in radii]

        def hit(ball: Any, pose: Any, center: Array) -> bool:
            pose.setTranslation(center)
            return bool(coal.collide(world, fixed, ball, pose, request, coal.CollisionResult()))

        return [any(map(hit, balls, poses, row)) for row in centers]

    return check


def _fcl_mesh(vertices: Array, triangles: Array, scene: Tabletop) -> SphereCheck:
    return _fcl_spheres(importlib.import_module("fcl"), fcl_mesh(vertices, triangles))


def _fcl_octree(vertices: Array, triangles: Array, scene: Tabletop) -> SphereCheck:
    return _fcl_spheres(importlib.import_module("fcl"), fcl_octree(_points_of(scene), CONSTANTS.octree_voxel))


def _fcl_spheres(fcl: Any, model: Any) -> SphereCheck:
    world = fcl.CollisionObject(model, fcl.Transform())

    def check(centers: Array, radii: Array) -> list[bool]:
        balls = [fcl.CollisionObject(fcl.Sphere(float(r)), fcl.Transform()) for r in radii]

        def hit(ball: Any, center: Array) -> bool:
            ball.setTranslation(center)
            return bool(fcl.collide(world, ball, fcl.CollisionRequest(), fcl.CollisionResult()))

        return [any(map(hit, balls, row)) for row in centers]

    return check


def _open3d(vertices: Array, triangles: Array, scene: Tabletop) -> SphereCheck:
    ray = o3d.t.geometry.RaycastingScene(nthreads=1)
    ray.add_triangles(
        o3d.core.Tensor.from_numpy(vertices.astype(np.float32)), o3d.core.Tensor.from_numpy(triangles.astype(np.uint32))
    )

    def check(centers: Array, radii: Array) -> list[bool]:
        queries = o3d.core.Tensor.from_numpy(np.ascontiguousarray(centers.reshape(-1, 3), dtype=np.float32))
        distance = ray.compute_distance(queries, nthreads=1).numpy().reshape(len(centers), -1)
        return [bool(hit) for hit in (distance <= radii).any(axis=1)]

    return check


def _points_of(scene: Tabletop) -> Array:
    """Sample about 100,000 points (P, 3) [m] on the surfaces of the shapes."""
    points: Array = scene.gaussians(100_000).means.numpy().astype(np.float64)
    return points


def _run_vamp(results: Results, case: str, scene: Tabletop, q: Array) -> None:
    """Check VAMP's own Panda against a CAPT of the cloud with its defaults: 2 cm spacing, point radius 2.5 mm."""
    try:
        vamp = importlib.import_module("vamp")
        robot = vamp.panda
        least, most = robot.min_max_radii()
        kept, _ = vamp.filter_pointcloud(
            _points_of(scene).tolist(), 0.02, 2.0, [0.0, 0.0, 0.0], [-2.0, -2.0, -2.0], [2.0, 2.0, 2.0], True
        )
        world = vamp.Environment()
        start = time.perf_counter()
        world.add_pointcloud(kept, least, most, 0.0025)
        built = time.perf_counter() - start
        start = time.perf_counter()
        hits = [not robot.validate(row, world) for row in q.tolist()]
        spent = time.perf_counter() - start
    except (ImportError, AttributeError, TypeError) as error:
        missing = importlib.util.find_spec("vamp") is None
        note = "absent: vamp is not installed (it has no wheel)" if missing else f"incompatible interface: {error}"
        results.add(case, "configurations a second", None, "1/s", peer="VAMP CAPT 2 cm", note=note)
        return
    results.add(case, "build", 1e3 * built, "ms", peer="VAMP CAPT 2 cm")
    results.add(case, "configurations a second", len(q) / spent, "1/s", peer="VAMP CAPT 2 cm")
    results.add(case, "share in collision", 100.0 * float(np.mean(hits)), "%", peer="VAMP CAPT 2 cm")


def mesh_of(scene: Tabletop) -> tuple[Array, Array]:
    """Return vertices (V, 3) [m] and triangles (T, 3) of the shapes."""
    vertices, triangles, count = [], [], 0
    for solid in scene.solids:
        mesh = solid_mesh(solid)
        vertices.append(mesh.vertices)
        triangles.append(mesh.triangles.astype(np.int64) + count)
        count += len(mesh.vertices)
    return np.concatenate(vertices), np.concatenate(triangles)


def solid_mesh(solid: object) -> TriangleMesh:
    """Return the triangle mesh of a block, can or ball."""
    if isinstance(solid, Block):
        x, y, z = solid.center
        return box(solid.size).placed([x, y, z - solid.size[2] / 2], solid.yaw)
    if isinstance(solid, Can):
        return cylinder(solid.radius, solid.height).placed(solid.foot)
    assert isinstance(solid, Ball)
    x, y, z = solid.center
    return sphere(solid.radius).placed([x, y, z - solid.radius])


def _least_seconds(query: Callable[[], object], runs: int = 5) -> float:
    best = np.inf
    for _ in range(runs):
        start = time.perf_counter()
        query()
        best = min(best, time.perf_counter() - start)
    return float(best)
