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
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.bench.training.sweep import simulated_data
from splatbot.evaluation.image import psnr
from splatbot.evaluation.surface import MeshScore, Surface, score_mesh
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.logs.synthetic import SyntheticLog
from splatbot.rasterize.maps import render_map
from splatbot.rasterize.meshes import METHODS, MeshMethod, map_mesh
from splatbot.training.datasets import TrainingData
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.options import TrainingOptions
from splatbot.training.session import TrainingSession

Kind = Literal["gaussians", "surfels"]

LOG = "synthetic:tabletop?frames=24&width=160&height=120&arc=100"
TOLERANCE = 5e-3  # [m]
_VOXEL = 5e-3  # [m]
_POINT_SIGMA = 0.01  # [m]
_STRIDE = 8  # [px] between the true points of a view


@dataclass(frozen=True)
class Measured:
    """A mesh of a trained map, compared with the truth.

    Args:
        kind: of the map.
        method: of the mesh.
        gaussians: number in the map.
        psnr_db: of the held-out views [dB].
        as_gaussians_db: the same, rendered by 3D Gaussian splatting, as other viewers do [dB].
        score: of the mesh.
    """

    kind: Kind
    method: MeshMethod
    gaussians: int
    psnr_db: float
    as_gaussians_db: float
    score: MeshScore


def measure(
    uri: str,
    iterations: int,
    most: int,
    methods: Sequence[MeshMethod] = METHODS,
    kinds: Sequence[Kind] = ("gaussians", "surfels"),
) -> Iterator[Measured]:
    """Train maps of each kind and yield their meshes.

    Args:
        uri: of the simulated log.
        iterations: steps of each training.
        most: largest number of Gaussians.
        methods: of meshes; the median depth is that of surfels alone.
        kinds: of maps.
    """
    log = SyntheticLog(uri)
    data = _disturbed(simulated_data(uri, 1))
    true, seen = true_surface(log), seen_points(log)
    views = [(view.camera, view.T_world_camera) for view in data.split()[0]]
    for kind in kinds:
        surfels = kind == "surfels"
        options = TrainingOptions(iterations=iterations, max_gaussians=most, surfels=surfels)
        model, psnr_db = _trained(data, options)
        as_gaussians_db = _psnr_as_gaussians(model, data)
        for method in methods if surfels else [method for method in methods if method != "median"]:
            mesh = map_mesh(model, views, _VOXEL, method)
            found = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
            score = score_mesh(found, true, seen, tolerance=TOLERANCE)
            yield Measured(kind, method, len(model), psnr_db, as_gaussians_db, score)


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


def _psnr_as_gaussians(model: GaussianModel, data: TrainingData) -> float:
    values = []
    for view in data.split()[1]:
        viewmat, K = torch.from_numpy(inverse(view.T_world_camera)), torch.from_numpy(view.camera.K_corner)
        with torch.no_grad():
            render = render_map(model, viewmat, K, view.camera.width, view.camera.height, surfels=False)
        values.append(psnr(render.image.clamp(0, 1).numpy(), view.read() / np.float32(255)))
    return fmean(values)


def main(argv: Sequence[str]) -> None:
    """Print a line for each mesh."""
    parser = argparse.ArgumentParser(prog="python -m experiments.surfel_meshes")
    parser.add_argument("--iterations", type=int, default=1200)
    parser.add_argument("--max-gaussians", type=int, default=3000)
    parser.add_argument("--log", default=LOG)
    parser.add_argument("--kinds", nargs="+", choices=("gaussians", "surfels"), default=["gaussians", "surfels"])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    given = parser.parse_args(argv)
    for m in measure(given.log, given.iterations, given.max_gaussians, given.methods, given.kinds):
        e = m.score
        print(
            f"{m.kind} ({m.gaussians:,}), {m.method}: accuracy {1e3 * e.accuracy_m:.2f} mm, completeness "
            f"{1e3 * e.completeness_m:.2f} mm, F-score {e.f_score:.3f} at {1e3 * TOLERANCE:g} mm, PSNR "
            f"{m.psnr_db:.2f} dB, {m.as_gaussians_db:.2f} dB as 3D Gaussians",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
