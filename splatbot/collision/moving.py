"""Space that dynamic objects passed through during mapping: cells that depth rays hit at times and passed later."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.collision.visibility import VisibilityEvidence
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.protocols import Array


@dataclass(frozen=True)
class MovingRegionConstants:
    """Constants of the regions of dynamic objects.

    Args:
        cell: [m] edge length of the cells of the grid.
        min_gaussians: smallest number of seen-through Gaussians around a cell of a dynamic object.
        min_share: smallest fraction of seen-through Gaussians around a cell; flying pixels lie next to static surfaces.
        padding: [m] distance added to a cell, because only the front of an object is seen, at the times of the frames
            only.
        solid_logit: logit of an opacity of 0.98.
    """

    cell: float = 0.02
    min_gaussians: int = 20
    min_share: float = 0.5
    padding: float = 0.02
    solid_logit: float = 4.0


CONSTANTS = MovingRegionConstants()


def find_moving(model: GaussianModel, evidence: VisibilityEvidence, *, around: float = CONSTANTS.padding) -> Array:
    """Return spheres (V, 4) = (x, y, z, radius) [m, world] that cover the space of dynamic objects; V may be 0.

    A Gaussian that was measured, but seen through more often, belongs to a dynamic object or is a flying pixel at an
    edge. Static surfaces surround flying pixels. A cell therefore counts if most measured Gaussians in it and its
    neighbours were seen through. A region that no later frame observes is not reported. An object that rests most of
    the time is part of the map.

    Args:
        model: the map, seen-through Gaussians included.
        evidence: its visibility, see :func:`splatbot.collision.gather_evidence`.
        around: padding of the cells [m].

    Raises:
        InputError: the evidence belongs to another model, or the padding is negative.
    """
    if len(evidence.hits) != len(model):
        raise InputError(f"is of {len(evidence.hits)} Gaussians.", field="evidence", hint=f"give {len(model)}")
    if not 0.0 <= around < np.inf:
        raise InputError(f"is {around}.", field="around", hint="give metres, 0 or more")
    measured = evidence.hits > 0
    points = model.means.detach().double().numpy()[measured]
    passed = evidence.seen_through[measured]
    if not passed.any():
        return np.zeros((0, 4))
    low = points[passed].min(axis=0) - 2 * CONSTANTS.cell
    shape = tuple((np.floor((points[passed].max(axis=0) - low) / CONSTANTS.cell) + 3).astype(np.int64))
    passed_count, count = (_histogram(part, low, shape) for part in (points[passed], points))
    nearby = _neighbourhood_sum(passed_count)
    enough = (nearby >= CONSTANTS.min_gaussians) & (nearby >= CONSTANTS.min_share * _neighbourhood_sum(count))
    cells = np.argwhere((passed_count > 0) & enough)
    radius = CONSTANTS.cell * np.sqrt(3.0) / 2 + around
    return np.c_[low + (cells + 0.5) * CONSTANTS.cell, np.full(len(cells), radius)]


def with_balls(model: GaussianModel, balls: Array, *, n_sigma: float, observations: int) -> GaussianModel:
    """Append spheres to a model as Gaussians whose ``n_sigma`` surfaces are the spheres.

    Args:
        model: the map.
        balls: (V, 4) = (x, y, z, radius) [m, world].
        n_sigma: standard deviations of the surface in the collision field.
        observations: number of observations of the new Gaussians; the gates of the field require enough.
    """
    count, degree = len(balls), model.sh_degree
    centers, radii = torch.from_numpy(balls[:, :3]).float(), torch.from_numpy(balls[:, 3]).float()
    more = GaussianModel(
        means=centers,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=(radii / n_sigma).log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), CONSTANTS.solid_logit),
        sh=torch.zeros(count, (degree + 1) ** 2, 3),
        observations=torch.full((count,), observations, dtype=torch.int32),
        anchors=torch.full((count,), -1, dtype=torch.int32),
    )
    return GaussianModel.concatenate([model, more])


def _histogram(points: Array, low: Array, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Count the points (P, 3) in each cell of a grid; points outside the grid are ignored."""
    cells = np.floor((points - low) / CONSTANTS.cell).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    return np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape)


def _neighbourhood_sum(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sum each cell and its 26 neighbours."""
    for axis in range(3):
        padded = np.pad(counts, [(int(k == axis),) * 2 for k in range(3)])
        parts = [np.take(padded, range(j, j + counts.shape[axis]), axis=axis) for j in range(3)]
        counts = parts[0] + parts[1] + parts[2]
    return counts
