"""Compare pruned maps with compacted ones: `python -m experiments.pruning RUN|TRAINING ...`.

Both keep the same number of Gaussians by the same importance. Pruning removes the least important ones.
`splatbot compact` replaces groups by Gaussians that enclose them. It prints the PSNR of held-out views. It also counts
spheres that hit the map but not the smaller one, at 2 and 3 standard deviations. Half of them just touch the map.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from splatbot.cli.map_views import recorded_views
from splatbot.collision import GaussianCollisionField
from splatbot.collision.solids import SolidGate
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.layouts import map_file
from splatbot.optimize.compact import compact
from splatbot.optimize.importance import blended_weights

SHARES = (0.75, 0.5, 0.25, 0.1)
_N_SIGMAS = (2.0, 3.0)
_SPREAD, _LARGEST = 0.03, 0.05  # [m] of the centres around Gaussians, and largest radius
_TOUCH = 1e-6  # [m]


class SmallerMaps(NamedTuple):
    """Quality of two smaller maps: PSNR of held-out views [dB], and missed ones of the spheres that hit the map."""

    share: float
    pruned_db: float
    compacted_db: float
    hits: int
    missed_by_pruned: int
    missed_by_compacted: int


def measure(folder: Path, spheres: int) -> list[SmallerMaps]:
    """Prune and compact the map of a run or a training, for each share of its Gaussians."""
    views = recorded_views(folder)
    if views is None:
        raise InputError("is no run and no training.", file=folder, field="RUN", hint="map a log first")
    model = GaussianModel.load(map_file(folder))
    weights = blended_weights(model, ((view.camera, view.T_world_camera) for view in views.mapped))
    order = torch.argsort(weights, descending=True, stable=True)
    rows = []
    for share in SHARES:
        count = round(share * len(model))
        small = model.select(order[:count].sort().values), compact(model, weights, count)
        pruned_db, compacted_db = (views.score(each, len(views.held_out))["psnr_db"] for each in small)
        found = [_missed(model, small, n_sigma, spheres // len(_N_SIGMAS)) for n_sigma in _N_SIGMAS]
        rows.append(SmallerMaps(share, pruned_db, compacted_db, *(int(total) for total in np.sum(found, axis=0))))
    return rows


def _missed(model: GaussianModel, small: Sequence[GaussianModel], n_sigma: float, count: int) -> list[int]:
    """Return how many spheres hit a map, and how many of these each smaller map misses."""
    rng = np.random.default_rng(0)
    field = GaussianCollisionField(model, n_sigma)
    means = model.means.numpy()[SolidGate().solid(model)]
    centres = means[rng.integers(0, len(means), count)] + rng.normal(0.0, _SPREAD, (count, 3))
    radii = rng.uniform(0.0, _LARGEST, count)
    touching = slice(count // 2, count)
    radii[touching] = np.maximum(field.clearance(centres[touching]).distance + _TOUCH, 0.0)
    balls = np.column_stack([centres, radii])
    hitting = balls[field.in_collision(balls)]
    fields = [GaussianCollisionField(each, n_sigma) for each in small]
    return [len(hitting), *(int(np.count_nonzero(~each.in_collision(hitting))) for each in fields)]


def main(argv: Sequence[str]) -> None:
    """Print a line for each folder and share, with 1,000,000 spheres each."""
    for name in argv:
        for row in measure(Path(name), 1_000_000):
            print(
                f"{name}, {row.share:.0%}: PSNR pruned {row.pruned_db:.1f} dB, compacted {row.compacted_db:.1f} dB; of "
                f"{row.hits:,} hits pruned misses {row.missed_by_pruned:,}, compacted {row.missed_by_compacted:,}"
            )


if __name__ == "__main__":
    main(sys.argv[1:])
