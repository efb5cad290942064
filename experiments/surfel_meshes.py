"""Compare meshes of surfels and of 3D Gaussians with the truth: `python -m experiments.surfel_meshes [--iterations N]`.

Both are trained for the same number of steps, from the same photographs of the simulated tabletop and the same points.
The points have the errors of points from photographs. The true surface is that of the simulated scene. It counts where
a view sees it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from splatbot.bench.training.sweep import simulated_data
from splatbot.evaluation.surface import MeshScore, Surface, score_mesh
from splatbot.gaussians import GaussianModel
from splatbot.logs.synthetic import SyntheticLog
from splatbot.rasterize.meshes import METHODS, MeshMethod, map_mesh
from splatbot.training.datasets import TrainingData
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.options import TrainingOptions
from splatbot.training.session import TrainingSession

LOG = "synthetic:tabletop?frames=48&width=320&height=240&arc=100"
TOLERANCE = 5e-3  # [m]
_VOXEL = 5e-3  # [m]
_POINT_SIGMA = 0.01  # [m]
_STRIDE = 8  # [px] between the true points of a view


@dataclass(frozen=True)
class Measured:
    """A mesh of a trained map, compared with the truth.

    Args:
        name: "surfels" or "3D Gaussians".
        method: of the mesh.
        gaussians: number in the map.
        psnr_db: of the held-out views [dB].
        score: of the mesh.
    """

    name: str
    method: MeshMethod
    gaussians: int
    psnr_db: float
    score: MeshScore


def measure(uri: str, iterations: int, most: int, methods: Sequence[MeshMethod] = METHODS) -> Iterator[Measured]:
    """Train both kinds of maps and yield their meshes.

    Args:
        uri: of the simulated log.
        iterations: steps of each training.
        most: largest number of Gaussians.
        methods: of meshes; the median depth is that of surfels alone.
    """
    log = SyntheticLog(uri)
    data = _disturbed(simulated_data(uri, 1))
    true, seen = true_surface(log), seen_points(log)
    views = [(view.camera, view.T_world_camera) for view in data.split()[0]]
    for surfels in (False, True):
        options = TrainingOptions(iterations=iterations, max_gaussians=most, surfels=surfels)
        model, psnr_db = _trained(data, options)
        for method in methods if surfels else [method for method in methods if method != "median"]:
            mesh = map_mesh(model, views, _VOXEL, method)
            found = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
            score = score_mesh(found, true, seen, tolerance=TOLERANCE)
            yield Measured("surfels" if surfels else "3D Gaussians", method, len(model), psnr_db, score)


def true_surface(log: SyntheticLog) -> Surface:
    """Return the surfaces of a static simulated scene as one mesh."""
    meshes = [surface.mesh for surface in log.scene.surfaces]
    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles.astype(np.int64) + first for mesh, first in zip(meshes, firsts, strict=False)]
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles)


def seen_points(log: SyntheticLog) -> NDArray[np.float64]:
    """Return points (P, 3) [m] of the true surface that the views see."""
    points = []
    for index, T in enumerate(log.ground_truth.T_world_camera):
        frame = log.read(index)
        local = frame.camera.backproject(frame.depth)[::_STRIDE, ::_STRIDE]
        known = frame.depth[::_STRIDE, ::_STRIDE] > 0
        points.append(local[known].astype(np.float64) @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(points)


def _disturbed(data: TrainingData) -> TrainingData:
    noise = np.random.default_rng(0).normal(scale=_POINT_SIGMA, size=data.points.shape)
    return replace(data, points=data.points + noise)


def _trained(data: TrainingData, options: TrainingOptions) -> tuple[GaussianModel, float]:
    with TemporaryDirectory() as folder:
        settings = TrainingSettings(Path(data.folder), 1, 8, options)
        session = TrainingSession(data, TrainingFolder(folder), settings, checkpoint_s=1e9)
        session.run()
        return session.trainer.model, float(session.score()["psnr_db"])


def main(argv: Sequence[str]) -> None:
    """Print a line for each mesh."""
    parser = argparse.ArgumentParser(prog="python -m experiments.surfel_meshes")
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--max-gaussians", type=int, default=6000)
    parser.add_argument("--log", default=LOG)
    given = parser.parse_args(argv)
    for m in measure(given.log, given.iterations, given.max_gaussians):
        e = m.score
        print(
            f"{m.name} ({m.gaussians:,}, PSNR {m.psnr_db:.2f} dB), {m.method}: accuracy {1e3 * e.accuracy_m:.2f} mm, "
            f"completeness {1e3 * e.completeness_m:.2f} mm, F-score {e.f_score:.3f} at {1e3 * TOLERANCE:g} mm",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
