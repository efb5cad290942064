"""Errors of the collision field of a map of a noisy log, against the true shapes, for spheres and for an arm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from splatbot.bench.results import Results
from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, RobotSpheres, surface_error
from splatbot.collision.visibility import measured_depths
from splatbot.gaussians import Snapshot
from splatbot.geometry import transform_points
from splatbot.logs import open_log
from splatbot.logs.scenes.tabletop import tabletop
from splatbot.logs.synthetic import SyntheticLog
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.slam import Slam

NOISY = "effects=depth_noise;depth_holes"
SHARE = 0.999  # share of the measured points whose error is within the margin
# The base is in front of the table, at its height, and faces it.
T_SCENE_BASE = np.array([[0.0, -1, 0, 0.0], [1, 0, 0, -0.55], [0, 0, 1, 0.0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Mapped:
    """A map of a noisy log, and the ground truth.

    Args:
        log: The mapped log.
        snapshot: The snapshot of its map.
        T_map_scene: (4, 4); the world frame of the map is its first camera.
        tracked: (F, 4, 4), estimated T_world_camera, NaN where lost.
        shapes: The true shapes in the frame of the scene.
    """

    log: SyntheticLog
    snapshot: Snapshot
    T_map_scene: Array
    tracked: Array
    shapes: o3d.t.geometry.RaycastingScene

    def views(self) -> Iterator[tuple[NDArray[np.float32], Camera, Array]]:
        """Yield depth, camera and estimated pose of each tracked frame, the information available to the map."""
        for frame, T in zip(self.log, self.tracked, strict=False):
            if np.isfinite(T).all():
                yield frame.depth, frame.camera, T

    def seen(self, points: Array) -> NDArray[np.bool_]:
        """Return whether the depth image of any frame, at its true pose, observes each surface point (P, 3)."""
        seen = np.zeros(len(points), np.bool_)
        for frame, T in zip(self.log, self.log.ground_truth.T_world_camera, strict=False):
            rows, measured, z = measured_depths(points, frame.depth, frame.camera, T)
            seen[rows[np.abs(measured - z) < 0.02]] = True
        return seen

    def closest(self, points: Array) -> tuple[Array, Array]:
        """Return signed distances (P,) of points in the scene, and the closest points (P, 3) of the true surface."""
        at = self.shapes.compute_closest_points(_tensor(points))["points"].numpy().astype(np.float64)
        inside = self.shapes.compute_occupancy(_tensor(points), nsamples=3).numpy() > 0
        distance = np.linalg.norm(at - points, axis=1)
        return np.where(inside, -distance, distance), at


def map_noisy_log(frames: int, width: int) -> Mapped:
    """Run SLAM over the synthetic table top with noise and holes in its depth."""
    log = open_log(f"synthetic:tabletop?frames={frames}&width={width}&height={width * 3 // 4}&{NOISY}")
    assert isinstance(log, SyntheticLog)
    slam = Slam()
    tracked = [slam.process(frame).T_world_camera for frame in log]
    slam.finish()
    poses = [np.full((4, 4), np.nan) if T is None else T for T in tracked]
    T = np.linalg.inv(log.ground_truth.T_world_camera[0])
    return Mapped(log, slam.snapshot(), T, np.array(poses), _true_shapes())


def audit_mapped_log(
    results: Results, *, frames: int, width: int, spheres: int, configurations: int, n_sigmas: tuple[float, ...]
) -> None:
    """Check random spheres in free space and random configurations of an arm, over n_sigma and margins.

    The margins are 0 and the surface error of the map. Results are separate for observed and unobserved surface: the
    true surface closest to a sphere, or in contact with the arm.
    """
    mapped = map_noisy_log(frames, width)
    for n_sigma in n_sigmas:
        field = GaussianCollisionField(mapped.snapshot, n_sigma)
        own = surface_error(field, mapped.views())
        margins = [0.0, own.share(SHARE)] if n_sigma == 2.0 else [0.0]
        for margin in margins:
            case = f"mapped noisy log, n_sigma {n_sigma:g}" + (f", margin {1e3 * margin:.1f} mm" if margin else "")
            results.add(case, "Gaussians", float(len(field)), "")
            for share in (0.5, 0.99, SHARE, 1.0):
                results.add(
                    case, f"surface error against the map's own depth, {share:.1%}", 1e3 * own.share(share), "mm"
                )
            audit_spheres(results, case, mapped, field, spheres, margin)
            audit_arm(results, case, mapped, field, configurations, margin)


def audit_spheres(
    results: Results, case: str, mapped: Mapped, field: GaussianCollisionField, count: int, margin: float
) -> None:
    """Check spheres of 2 to 8 cm whose centres are in the free space above the table."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.55, -0.40, 0.0], [0.55, 0.35, 0.35], (3 * count, 3))
    distance, nearest = mapped.closest(points)
    points, distance, nearest = (x[distance > 0][:count] for x in (points, distance, nearest))
    radii = rng.uniform(0.02, 0.08, len(points))
    seen = mapped.seen(nearest)
    hit = field.in_collision(np.c_[transform_points(mapped.T_map_scene, points), radii + margin])
    error = np.maximum(field.clearance(transform_points(mapped.T_map_scene, nearest[seen])).distance, 0)
    for share in (0.5, 0.99, SHARE, 1.0):
        value = 1e3 * float(np.quantile(error, share))
        results.add(case, f"surface error against the truth, observed, {share:.1%}", value, "mm")
    for name, part in (("observed", seen), ("unobserved", ~seen)):
        clearance, struck = (distance - radii)[part], hit[part]
        free, false = ~struck & (clearance <= 0), struck & (clearance > 0)
        results.add(case, f"spheres, {name}: false free", float(free.sum()), f"of {len(clearance)}")
        results.add(case, f"spheres, {name}: deepest", 1e3 * float(-clearance[free].min()) if free.any() else 0.0, "mm")
        results.add(case, f"spheres, {name}: false hit", 100.0 * float(false.mean()), "%")
        largest = 1e3 * float(clearance[false].max()) if false.any() else 0.0
        results.add(case, f"spheres, {name}: largest false hit", largest, "mm")


def audit_arm(
    results: Results, case: str, mapped: Mapped, field: GaussianCollisionField, count: int, margin: float
) -> None:
    """Check configurations without self-collision of an arm in front of the table."""
    bare = RobotSpheres(panda(), T_world_base=mapped.T_map_scene @ T_SCENE_BASE)
    wide = RobotSpheres(panda(), T_world_base=mapped.T_map_scene @ T_SCENE_BASE, margin=margin)
    q = panda().random(2 * count, np.random.default_rng(1))
    q = q[~bare.check(None, q).in_collision][:count]
    moving = bare.spheres.link > 0
    radii = bare.spheres.radii[moving]
    centers = transform_points(np.linalg.inv(mapped.T_map_scene), bare.centers(q)[:, moving].reshape(-1, 3))
    distance, nearest = mapped.closest(centers)
    clearance = distance.reshape(len(q), -1) - radii
    struck = wide.check(field, q).in_collision
    touching = clearance <= 0
    flat = np.zeros(clearance.size, np.bool_)
    flat[touching.ravel()] = mapped.seen(nearest[touching.ravel()])
    seen = flat.reshape(clearance.shape)
    for name, part in (("observed", seen), ("unobserved", touching & ~seen)):
        touches = (touching & part).any(axis=1) if name == "observed" else part.any(axis=1) & ~seen.any(axis=1)
        free = touches & ~struck
        depth = np.where(part, -clearance, 0.0).max(axis=1)
        results.add(case, f"arm, {name}: false free", float(free.sum()), f"of {int(touches.sum())} in contact")
        results.add(case, f"arm, {name}: deepest", 1e3 * float(depth[free].max()) if free.any() else 0.0, "mm")
    clear = ~touching.any(axis=1)
    results.add(case, "arm: false hit", 100.0 * float(struck[clear].mean()), f"% of {int(clear.sum())} that are free")
    results.add(case, "arm: reported free", 100.0 * float((~struck).mean()), f"% of {len(q)}")


def _true_shapes() -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    for surface in tabletop().surfaces:
        vertices, triangles = surface.mesh.vertices.astype(np.float32), surface.mesh.triangles.astype(np.uint32)
        scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles))
    return scene


def _tensor(points: Array) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
