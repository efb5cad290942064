"""Segmentation of connected structures that are too large for an object."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.bench.tabletop import Block, Tabletop
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.segmentation import segment
from splatbot.segmentation.concave_edges import split_at_concave_edges

BOARD = Block((0.75, 0.0, -0.01), (0.5, 0.6, 0.02))
BACK = Block((0.95, 0.0, 0.15), (0.01, 0.5, 0.30))
LEFT, RIGHT = (Block((0.75, y, 0.15), (0.40, 0.01, 0.30)) for y in (0.245, -0.245))
BOX = Block((0.88, 0.05, 0.06), (0.13, 0.10, 0.12))  # it touches the back wall
SLAB = Block((0.70, -0.225, 0.10), (0.15, 0.02, 0.20))  # it stands flat against the right wall
EYE = np.array([0.2, 0.05, 0.25])


def _seen(*solids: Block) -> tuple[GaussianModel, np.ndarray]:
    """Return the Gaussians of a shelf that EYE observes, with 1 mm of noise, and the solid of each Gaussian."""
    model = Tabletop((BOARD, BACK, LEFT, RIGHT, *solids)).gaussians(120_000)
    points = model.means.double().numpy()
    away = np.abs(np.stack([s.distance(points) for s in (BOARD, BACK, LEFT, RIGHT, *solids)]))
    normals = _normals(points, (BOARD, BACK, LEFT, RIGHT, *solids), away.argmin(axis=0))
    facing = np.einsum("ij,ij->i", normals, EYE - points) > 0
    for k, solid in enumerate(solids):  # points behind them are occluded
        toward = points + (EYE - points) * np.linspace(0.02, 0.5, 60)[:, None, None]
        hidden = (solid.distance(toward.reshape(-1, 3)).reshape(60, -1) < -2e-3).any(axis=0)
        facing &= ~hidden | (away.argmin(axis=0) == 4 + k)
    rows = np.flatnonzero(facing)
    model = model.select(torch.from_numpy(rows))
    model.means += torch.from_numpy(np.random.default_rng(0).normal(0, 1e-3, (len(rows), 3))).float()
    return model, away.argmin(axis=0)[rows]


def _normals(points: np.ndarray, solids: tuple[Block, ...], owner: np.ndarray) -> np.ndarray:
    found = np.zeros_like(points)
    for axis in range(3):
        step = 1e-5 * np.eye(3)[axis]
        for k, solid in enumerate(solids):
            m = owner == k
            found[m, axis] = (solid.distance(points[m] + step) - solid.distance(points[m] - step)) / 2e-5
    return found


def _shares(rows: np.ndarray, owner: np.ndarray, solid: int) -> tuple[float, float]:
    """Compute the fraction of a part that is on a solid, and the fraction of the solid that is in the part."""
    own = owner[rows] == solid
    return float(own.mean()), float(own.sum() / (owner == solid).sum())


def test_objects_in_contact_with_the_walls_of_a_shelf_are_separated() -> None:
    model, owner = _seen(BOX, SLAB)
    eyes = np.tile(EYE, (len(model), 1))
    found = segment(model, np.eye(4), observers=eyes)
    for solid in (4, 5):
        pure, whole = max((_shares(o.rows, owner, solid) for o in found.objects), key=lambda s: s[0] * s[1])
        assert pure > 0.95
        assert whole > 0.85
    for thing in found.objects:
        assert np.isin(owner[thing.rows], (2, 3)).mean() < 0.2 or len(thing.rows) < 0.2 * (owner == 2).sum()


def test_without_observers_a_shelf_is_no_object() -> None:
    model, _ = _seen(BOX, SLAB)
    assert not [o for o in segment(model, np.eye(4)).objects if o.size.max() > 0.05]


def test_faces_without_a_known_observer_are_parts_of_their_own() -> None:
    model, owner = _seen(BOX)
    rows = np.flatnonzero(owner >= 1)
    points = model.means.double().numpy()[rows]
    parts = split_at_concave_edges(points, np.full_like(points, np.nan), apart=0.012, fewest=40)
    assert len(parts) > len(split_at_concave_edges(points, np.tile(EYE, (len(points), 1)), apart=0.012, fewest=40))


def test_a_part_has_the_minimum_size_and_no_row_is_in_two() -> None:
    model, owner = _seen(BOX, SLAB)
    rows = np.flatnonzero(owner >= 1)
    points = model.means.double().numpy()[rows]
    parts = split_at_concave_edges(points, np.tile(EYE, (len(points), 1)), apart=0.012, fewest=40)
    together = np.concatenate(parts)
    assert len(np.unique(together)) == len(together)
    assert min(map(len, parts)) >= 40
    assert [len(p) for p in parts] == sorted((len(p) for p in parts), reverse=True)


def test_observers_of_another_map_are_refused() -> None:
    model, _ = _seen(BOX)
    with pytest.raises(InputError, match="observers"):
        segment(model, np.eye(4), observers=np.zeros((3, 3)))
