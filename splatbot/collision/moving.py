"""Where something moved while the map was made: places that were occupied at times, and seen through more often."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.collision.visibility import VisibilityEvidence
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.protocols import Array

CELL = 0.02  # [m] of the grid in which places are gathered
FEWEST = 20  # Gaussians around a cell; fewer are no thing that moves
_SHARE = 0.5  # of the Gaussians around a cell that must have gone; flying pixels are beside what stays
AROUND = 0.02  # [m] added to a cell: only the thing's front was seen, and not where it was between two frames
_SOLID = 4.0  # logit of an opacity of 0.98


def find_moving(model: GaussianModel, evidence: VisibilityEvidence, *, around: float = AROUND) -> Array:
    """Balls (V, 4) = (x, y, z, radius) [m, world] that cover where something was at times; V is 0 if nothing moved.

    A Gaussian whose place was measured, and was seen through more often than that, is of a thing that was there for
    a while, or a flying pixel at an edge. Edges belong to what stays: so a cell counts where, with the cells next to
    it, most of what was measured has gone. What nobody looked at again is not known to have gone, and what stood still
    for most of the time is in the map.

    Args:
        model: the map, with what was seen through.
        evidence: of it, see :func:`splatbot.collision.gather_evidence`.
        around: room beside the cells [m].

    Raises:
        InputError: the evidence is of another model, or the room is negative.
    """
    if len(evidence.hits) != len(model):
        raise InputError(f"is of {len(evidence.hits)} Gaussians.", field="evidence", hint=f"give {len(model)}")
    if not 0.0 <= around < np.inf:
        raise InputError(f"is {around}.", field="around", hint="give metres, 0 or more")
    measured = evidence.hits > 0
    points = model.means.detach().double().numpy()[measured]
    gone = evidence.seen_through[measured]
    if not gone.any():
        return np.zeros((0, 4))
    low = points[gone].min(axis=0) - 2 * CELL
    shape = tuple((np.floor((points[gone].max(axis=0) - low) / CELL) + 3).astype(np.int64))
    here, all_around = (_counted(part, low, shape) for part in (points[gone], points))
    most = _beside(here)
    cells = np.argwhere((here > 0) & (most >= FEWEST) & (most >= _SHARE * _beside(all_around)))
    radius = CELL * np.sqrt(3.0) / 2 + around
    return np.c_[low + (cells + 0.5) * CELL, np.full(len(cells), radius)]


def with_balls(model: GaussianModel, balls: Array, *, n_sigma: float, observations: int) -> GaussianModel:
    """A model and after it balls (V, 4) [m, world] as Gaussians, whose surface is theirs at ``n_sigma``.

    Args:
        model: the map.
        balls: centres and radii.
        n_sigma: of the field that they are for.
        observations: that they count as, so that no gate takes them for air.
    """
    count, degree = len(balls), model.sh_degree
    centers, radii = torch.from_numpy(balls[:, :3]).float(), torch.from_numpy(balls[:, 3]).float()
    more = GaussianModel(
        means=centers,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=(radii / n_sigma).log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), _SOLID),
        sh=torch.zeros(count, (degree + 1) ** 2, 3),
        observations=torch.full((count,), observations, dtype=torch.int32),
        anchors=torch.full((count,), -1, dtype=torch.int32),
    )
    return GaussianModel.concatenate([model, more])


def _counted(points: Array, low: Array, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """How many of points (P, 3) are in each cell of a grid; those outside of it are left out."""
    cells = np.floor((points - low) / CELL).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    return np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape)


def _beside(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sums of each cell and its 26 neighbours."""
    for axis in range(3):
        padded = np.pad(counts, [(int(k == axis),) * 2 for k in range(3)])
        parts = [np.take(padded, range(j, j + counts.shape[axis]), axis=axis) for j in range(3)]
        counts = parts[0] + parts[1] + parts[2]
    return counts
