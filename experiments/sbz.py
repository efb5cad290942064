"""Measure SBZ files of mapped logs: `python -m experiments.sbz RUN ...`.

It encodes and decodes the map of each run. It prints the size, the growth of the axes, and the loss of PSNR of
held-out views. It also counts the spheres that collide with the map, but not with the decoded one. Half of the spheres
are around random Gaussians, and the others just touch the map.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField
from splatbot.collision.solids import SCALE_FLOOR
from splatbot.formats.sbz import load_sbz, save_sbz
from splatbot.gaussians import GaussianModel
from splatbot.results.folder import RunFolder
from splatbot.results.scoring import score_views
from splatbot.robots.in_view import reopen_log

Array = NDArray[np.float64]

N_SIGMAS = (1.0, 2.0, 3.0)
_BATCH = 500_000  # spheres
_SPREAD, _LARGEST = 0.03, 0.05  # [m] of the centres around Gaussians, and largest radius
_TOUCH = 1e-6  # [m]


@dataclass(frozen=True)
class Comparison:
    """A map and its SBZ file.

    Args:
        gaussians: number of Gaussians.
        bytes_each: size of the file for each Gaussian.
        save_s, load_s: [s] for the whole map.
        growth: geometric mean of the factors of all axes.
        loss_db: mean loss of PSNR of the held-out views.
        worst_db: largest loss of one view.
        spheres: number of spheres.
        hits: spheres that collide with the map.
        missed: spheres that collide with the map, but not with the decoded one.
    """

    gaussians: int
    bytes_each: float
    save_s: float
    load_s: float
    growth: float
    loss_db: float
    worst_db: float
    spheres: int
    hits: int
    missed: int


def compare(folder: Path, spheres: int) -> Comparison:
    """Encode and decode the map of a run, and compare both maps with ``spheres`` spheres at 1 to 3 sigma."""
    run = RunFolder(folder)
    model = GaussianModel.load(run.map)
    with TemporaryDirectory() as place:
        file = Path(place) / "map.sbz"
        start = time.perf_counter()
        save_sbz(model, file)
        saved = time.perf_counter()
        back = load_sbz(file)
        loaded = time.perf_counter()
        size = file.stat().st_size
    loss = _losses(run, model, back)
    hits, missed = _collisions(model, back, spheres)
    return Comparison(
        gaussians=len(model),
        bytes_each=size / len(model),
        save_s=saved - start,
        load_s=loaded - saved,
        growth=float(np.exp(_mean_log_scale(back) - _mean_log_scale(model))),
        loss_db=float(loss.mean()),
        worst_db=float(loss.max()),
        spheres=spheres,
        hits=hits,
        missed=missed,
    )


def _mean_log_scale(model: GaussianModel) -> float:
    return float(np.log(np.maximum(model.scales.numpy().astype(np.float64), SCALE_FLOOR)).mean())


def _losses(run: RunFolder, model: GaussianModel, back: GaussianModel) -> Array:
    """Return the loss of PSNR [dB] of each held-out view."""
    log, poses = reopen_log(run), run.load_poses()
    chosen = {row.index: poses[row.index] for row in run.load_frames() if row.held_out and row.index in poses}
    was, now = ([view.psnr_db for view in score_views(log, either, chosen).scores] for either in (model, back))
    return np.array(was) - np.array(now)


def _collisions(model: GaussianModel, back: GaussianModel, count: int) -> tuple[int, int]:
    """Return how many spheres collide with a map, and how many of these are free in the decoded one."""
    rng, hits, missed = np.random.default_rng(0), 0, 0
    fields = [[GaussianCollisionField(either, n_sigma) for either in (model, back)] for n_sigma in N_SIGMAS]
    for batch, start in enumerate(range(0, count, _BATCH)):
        first, second = fields[batch % len(fields)]
        n = min(_BATCH, count - start)
        centres = model.means.numpy()[rng.integers(0, len(model), n)] + rng.normal(0.0, _SPREAD, (n, 3))
        radii = rng.uniform(0.0, _LARGEST, n)
        touching = slice(n // 2, n)
        radii[touching] = np.maximum(first.clearance(centres[touching]).distance + _TOUCH, 0.0)
        balls = np.column_stack([centres, radii])
        collides = first.in_collision(balls)
        hits += int(np.count_nonzero(collides))
        missed += int(np.count_nonzero(collides & ~second.in_collision(balls)))
    return hits, missed


def main(argv: Sequence[str]) -> None:
    """Print a line for each run folder, with 10,000,000 spheres."""
    for name in argv:
        c = compare(Path(name), 10_000_000)
        print(f"{name}: {c.gaussians:,} Gaussians, {c.bytes_each:.2f} bytes each")
        print(f"    axes grow by {c.growth - 1:.1%}; write {c.save_s:.1f} s, read {c.load_s:.1f} s")
        print(f"    PSNR loss {c.loss_db:.3f} dB, of the worst view {c.worst_db:.2f} dB")
        print(f"    {c.hits:,} of {c.spheres:,} spheres collide, {c.missed} of these are free in the decoded map")


if __name__ == "__main__":
    main(sys.argv[1:])
