"""Errors of the collision field of a mapped recording against its raw depth images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
import open3d as o3d
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from splatbot.bench.results import Results
from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField
from splatbot.evaluation.depth_fusion import DepthFusion
from splatbot.evaluation.geometry import depth_error
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.geometry import transform_points
from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.shapes import TriangleMesh
from splatbot.logs.textures import Texture
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.scoring import score_views
from splatbot.robots.in_view import reopen_log


@dataclass(frozen=True)
class FusedSurfaceConstants:
    """Constants of the fused surface.

    Args:
        voxel: [m] voxel size.
        max_depth: [m] largest depth that is fused.
    """

    voxel: float = 0.01
    max_depth: float = 10.0


CONSTANTS = FusedSurfaceConstants()


_GREY = (0.5, 0.5, 0.5)  # colour of the fused surface, which no result depends on


def audit_run(results: Results, run: Path, out: Path, *, points: int, min_observations: int = 1) -> None:
    """Compare the clearance of a mapped recording with its raw depth, at random points in free space.

    The first reference is the closest of all raw points, including outliers and noise towards the camera. The second
    is the surface that Open3D fuses from the frames that were not held out. Its TSDF has voxels of 1 cm and needs three
    measurements. The difference of both references is reported too, because no map can be closer to both.
    The fused surface and the map are also compared with the depth of held-out frames.

    Points are sampled along the rays of random pixels, in front of the measured depth. ``NAME-field.jpg`` shows a slice
    of the field next to the image that it intersects.
    """
    folder = RunFolder(run)
    name = str(folder.load_metrics()["log"]["name"])
    log = reopen_log(folder)
    poses = folder.load_poses()
    model = GaussianModel.load(folder.map)
    field = GaussianCollisionField(model, min_observations=min_observations)
    rng = np.random.default_rng(0)
    held_out = {row.index for row in folder.load_frames() if row.held_out}
    clouds, free, fusion = [], [], DepthFusion(CONSTANTS.voxel, CONSTANTS.max_depth)
    each = -(-points // len(poses))
    for index, T in sorted(poses.items()):
        frame = log[index]
        v, u = np.nonzero(np.isfinite(frame.depth) & (frame.depth > 0))
        clouds.append(lifted(frame.depth, u[::3], v[::3], frame.camera, T))
        if index not in held_out:
            fusion.add(frame.depth, frame.camera, T)
        chosen = rng.integers(0, len(u), each)
        surface = lifted(frame.depth, u[chosen], v[chosen], frame.camera, T)
        free.append(T[:3, 3] + rng.uniform(0.1, 0.95, (each, 1)) * (surface - T[:3, 3]))
    cloud, queries = np.concatenate(clouds), np.concatenate(free)[:points]
    distance = field.clearance(queries).distance
    case = f"{name}, {len(queries)} points in free space"
    results.add(case, "Gaussians", float(len(field)), "")
    raw, fused = _nearest(cloud, queries), _nearest(fusion.points(), queries)
    compared = {
        "clearance against raw depth": distance - raw,
        "clearance against fused depth": distance - fused,
        "fused against raw depth": fused - raw,
    }
    for metric, error in compared.items():
        for share in (50, 90, 95):
            results.add(case, f"{metric}, {share} %", 1e3 * float(np.percentile(np.abs(error), share)), "mm")
    fused_mesh = fusion.mesh()
    mesh = TriangleMesh(np.asarray(fused_mesh.vertices), np.asarray(fused_mesh.triangles).astype(np.uint32))
    seen = RaycastScene([RaycastSurface(mesh, Texture(_GREY, _GREY, 1.0))])
    frames = [(log[index], poses[index]) for index in sorted(held_out & poses.keys())]
    errors = [depth_error(seen.render(frame.camera, T)[1], frame.depth).l1 for frame, T in frames]
    _add_mean(results, f"{name}, held-out views", "depth error, mean, fused depth", errors)
    scores = score_views(log, model, {frame.index: T for frame, T in frames}).scores
    _add_mean(results, f"{name}, held-out views", "depth error, mean, map", [score.depth_l1_m for score in scores])
    _picture(field, log[min(poses)], poses[min(poses)], cloud, out / f"{name}-field.jpg")


def _add_mean(results: Results, case: str, metric: str, errors: list[float | None]) -> None:
    known = [error for error in errors if error is not None]
    if known:
        results.add(case, metric, 1e3 * float(np.mean(known)), "mm")


def lifted(depth: NDArray[np.float32], u: NDArray[np.int64], v: NDArray[np.int64], camera: Camera, T: Array) -> Array:
    """Backproject pixels (u, v) with ``T`` = T_world_camera (4, 4) to points (P, 3) [m, world]."""
    z = depth[v, u].astype(np.float64)
    return transform_points(T, np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1))


def _nearest(cloud: Array, queries: Array) -> Array:
    """Return the distance (P,) [m] to the closest point of a cloud (N, 3)."""
    search = o3d.core.nns.NearestNeighborSearch(_tensor(cloud))
    search.knn_index()
    _, squared = search.knn_search(_tensor(queries), 1)
    return np.sqrt(squared.numpy()[:, 0].astype(np.float64))


def _picture(field: GaussianCollisionField, frame: Frame, T: Array, cloud: Array, path: Path) -> None:
    """Plot the vertical plane through the centre of the first view: clearance, measured points, and the view."""
    valid = frame.depth[np.isfinite(frame.depth) & (frame.depth > 0)]
    far = 1.5 * float(np.median(valid))
    half = far * frame.camera.height / frame.camera.fy / 2
    z, y = np.meshgrid(np.linspace(0.05, far, 360), np.linspace(-half, half, 240))
    plane = transform_points(T, np.stack([np.zeros(z.size), y.ravel(), z.ravel()], axis=1))
    distance = field.clearance(plane, cut=0.5).distance.reshape(z.shape)
    local = transform_points(np.linalg.inv(T), cloud)
    near = local[np.abs(local[:, 0]) < 0.004]
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), width_ratios=(1, 1.5))
    axes[0].imshow(frame.rgb)
    axes[0].axvline(frame.camera.cx, color="#d1495b")
    axes[0].set_axis_off()
    shown = axes[1].pcolormesh(z, y, np.minimum(distance, 0.3), cmap="viridis", vmin=-0.02, vmax=0.3, shading="auto")
    axes[1].contour(
        z, y, np.minimum(distance, 0.5), levels=[0.0, 0.05, 0.1], colors=["w", "0.8", "0.6"], linewidths=0.8
    )
    axes[1].plot(near[::5, 2], near[::5, 1], ",", color="#d1495b", alpha=0.5)
    axes[1].set(xlim=(0.05, far), ylim=(half, -half), xlabel="forward [m]", ylabel="down [m]")
    axes[1].set_aspect("equal")
    figure.colorbar(shown, ax=axes[1], label="clearance [m]", shrink=0.8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _tensor(values: Array) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
