"""Blocks of a scene along a kd-tree, each trained apart, as in VastGaussian (Lin et al. 2024).

A block owns the Gaussians whose centres lie inside, at the start where training keeps all, else at the end. It trains
them with those of a margin, and with every eighth of the others that its views see. Both explain the rest of its
images, and are dropped at the merge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.training.datasets import TrainingView

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class BlockConstants:
    """Constants of blocks.

    Args:
        margin: width of the overlap [share of the block's largest side].
        least_share: a view trains a block that holds a larger share of the points in its image.
        far_each: number of Gaussians beyond the margin of which one is kept, as large as all of them together.
        most: largest number of blocks.
    """

    margin: float = 0.1
    least_share: float = 0.1
    far_each: int = 8
    most: int = 1024


CONSTANTS = BlockConstants()


@dataclass(frozen=True)
class Cut:
    """A plane across an axis of the world, and a side of it.

    Args:
        axis: 0 to 2.
        place: coordinate of the plane [m].
        above: whether the side is that of the larger coordinates, with the plane itself.
    """

    axis: int
    place: float
    above: bool


@dataclass(frozen=True)
class SceneBlock:
    """A part of space, and the views that train it.

    Args:
        cuts: the block is on the named side of each.
        margin: width of the overlap [m].
        views: names of the views.
    """

    cuts: tuple[Cut, ...]
    margin: float
    views: tuple[str, ...]

    def holds(self, points: Array, margin: float = 0.0) -> Mask:
        """Return whether points (N, 3) lie in the block, or up to a margin outside; each point is in one block."""
        inside = np.ones(len(points), dtype=bool)
        for cut in self.cuts:
            x = points[:, cut.axis]
            inside &= x >= cut.place - margin if cut.above else x < cut.place + margin
        return inside


def cut_scene(points: Array, views: Sequence[TrainingView], count: int) -> list[SceneBlock]:
    """Cut a scene into blocks of as many points each, across the longest axis at a time.

    Args:
        points: (N, 3) of the start.
        views: the training views.
        count: number of blocks.

    Raises:
        InputError: the number is out of range, too many points lie in one place, or no view shows enough of a block.
    """
    if not 2 <= count <= min(CONSTANTS.most, len(points)):
        most = min(CONSTANTS.most, len(points))
        raise InputError(f"is {count} for {len(points)} points.", field="--blocks", hint=f"give 1 to {most}")
    leaves = [SceneBlock(cuts, CONSTANTS.margin * _side(inside), ()) for cuts, inside in _halve(points, count)]
    names: list[list[str]] = [[] for _ in leaves]
    for view in views:
        seen = points[in_view(view, points)]
        if not len(seen):
            continue
        held = np.array([np.count_nonzero(leaf.holds(seen, leaf.margin)) for leaf in leaves])
        trained = held > CONSTANTS.least_share * len(seen)
        trained[np.argmax(held)] = True
        for number in np.flatnonzero(trained):
            names[number].append(view.name)
    if not all(names):
        hint = "use fewer blocks, or add views"
        raise InputError(
            f"is {count}, and no view shows enough of block {names.index([]) + 1}.", field="--blocks", hint=hint
        )
    return [SceneBlock(leaf.cuts, leaf.margin, tuple(of)) for leaf, of in zip(leaves, names, strict=True)]


def start_of(model: GaussianModel, block: SceneBlock, views: Sequence[TrainingView], seed: int) -> GaussianModel:
    """Return the Gaussians that the training of a block starts from: those up to its margin, and a few of the others.

    Args:
        model: start of the whole scene.
        block: the block.
        views: the training views.
        seed: of the choice.
    """
    points = model.means.double().numpy()
    near = block.holds(points, block.margin)
    far = np.zeros(len(points), dtype=bool)
    for view in views:
        if view.name in block.views:
            far |= in_view(view, points)
    rows = np.flatnonzero(far & ~near)
    drawn = np.random.default_rng(seed).choice(rows, len(rows) // CONSTANTS.far_each, replace=False)
    sparse = model.select(torch.from_numpy(np.sort(drawn)))
    sparse.log_scales += 0.5 * math.log(CONSTANTS.far_each)  # of surfaces: the same area
    return GaussianModel.concatenate([model.select(torch.from_numpy(near)), sparse])


def merged(parts: Sequence[tuple[SceneBlock, Path, Path | None]]) -> GaussianModel:
    """Return the Gaussians of trained blocks, each of the block that owns it.

    Maps are read one at a time, and twice: memory then holds the result and one block.

    Args:
        parts: each block, the file of its map, and that of its start if training keeps its rows. A Gaussian that
            crosses a cut then keeps its owner, so that none is lost or doubled. Without it, the trained place counts.

    Raises:
        FormatError: a map has another number of Gaussians than its start.
    """
    sizes = [(len(part), part.sh.shape[1]) for part in map(_owned, parts)]
    count, bands = sum(rows for rows, _ in sizes), max(bands for _, bands in sizes)
    empty = vars(GaussianModel.empty()) | {"sh": torch.zeros(0, bands, 3)}
    columns = {name: torch.zeros(count, *tensor.shape[1:], dtype=tensor.dtype) for name, tensor in empty.items()}
    whole, end = GaussianModel(**columns), 0
    for part in map(_owned, parts):
        begin, end = end, end + len(part)
        for name, tensor in vars(part).items():
            rows = getattr(whole, name)[begin:end]
            (rows[:, : part.sh.shape[1]] if name == "sh" else rows).copy_(tensor)
    return whole


def _owned(part: tuple[SceneBlock, Path, Path | None]) -> GaussianModel:
    block, file, start = part
    owned = None if start is None else _held(block, GaussianModel.load(start))  # one model in memory at a time
    model = GaussianModel.load(file)
    if owned is None:
        owned = _held(block, model)
    if len(owned) != len(model):
        hint = "train the block again: remove its checkpoint.pt and scores.json, then --resume"
        raise FormatError(f"has {len(model)} Gaussians, its start {len(owned)}.", file=file, hint=hint)
    return model.select(owned)


def _held(block: SceneBlock, model: GaussianModel) -> torch.Tensor:
    """Return whether each Gaussian (N,) has its centre in the block."""
    return torch.from_numpy(block.holds(model.means.double().numpy()))


def in_view(view: TrainingView, points: Array) -> Mask:
    """Return which points (N, 3) are in front of a camera and inside its image."""
    T_camera_world = inverse(view.T_world_camera)
    p = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    front = p[:, 2] > 1e-6
    u, v = view.camera.project(np.where(front[:, None], p, [0.0, 0.0, 1.0])).T
    return np.asarray(front & (u >= 0) & (v >= 0) & (u < view.camera.width) & (v < view.camera.height))


def _halve(points: Array, count: int) -> list[tuple[tuple[Cut, ...], Array]]:
    """Return the cuts and the points of each leaf of a kd-tree with ``count`` leaves."""
    if count == 1:
        return [((), points)]
    below = count // 2
    axis, place = _plane(points, below, count - below)
    above = points[:, axis] >= place
    return [
        ((Cut(axis, place, side), *cuts), inside)
        for side, part, share in ((False, points[~above], below), (True, points[above], count - below))
        for cuts, inside in _halve(part, share)
    ]


def _plane(points: Array, below: int, above: int) -> tuple[int, float]:
    """Return axis and place of the cut that gives each leaf a share of the points, across the longest axis that can.

    Args:
        points: (M, 3) to cut.
        below, above: number of leaves of each side; a side has at least as many points.

    Raises:
        InputError: no axis has a cut.
    """
    share = below / (below + above)
    for axis in np.argsort(-_sides(points), kind="stable"):
        x = np.sort(points[:, axis])
        middle = float(np.quantile(x, share))
        places = np.append(middle, np.unique(x))  # the nearest to the middle where many points share a coordinate
        smaller = np.searchsorted(x, places)
        allowed = (smaller >= below) & (len(x) - smaller >= above)
        if allowed[0]:
            return int(axis), middle
        if allowed.any():
            away = np.where(allowed, np.abs(smaller - share * len(x)), np.inf)
            return int(axis), float(places[np.argmin(away)])
    raise InputError("is too large: too many points lie in one place.", field="--blocks", hint="use fewer blocks")


def _sides(points: Array) -> Array:
    """Return the sides (3,) [m] of the box that holds most points; a few points far away do not count."""
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    return np.asarray(high - low)


def _side(points: Array) -> float:
    return float(_sides(points).max())
