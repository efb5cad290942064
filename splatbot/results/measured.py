"""Measured surface that the map of a run lacks, as spheres that plans avoid."""

from __future__ import annotations

import hashlib
import threading
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.confirmed import confirmed_cells
from splatbot.gaussians import GaussianModel
from splatbot.logs import Log
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.results.views import raw_views


@dataclass(frozen=True)
class MeasuredSurfaceConstants:
    """Constants of the measured surface.

    Args:
        frames: largest number of frames whose depth counts.
        cell: [m] edge of a cell. One with a confirmed point is an obstacle as a whole. Larger ones are fewer.
        block: [m] edge of the cubes of space that are searched and kept as a whole.
        farthest: [m] from the base of an arm up to which surface is searched.
    """

    frames: int = 256
    cell: float = 0.004
    block: float = 0.4
    farthest: float = 10.0


CONSTANTS = MeasuredSurfaceConstants()


class MeasuredSurface:
    """Surface that a run measured outside of the ellipsoids of its map, as spheres around cells of a grid.

    All pixels with depth of at most 256 evenly spaced frames count. A second frame must measure the same depth there,
    and at most a tenth of the frames may see through the point (:func:`splatbot.collision.confirmed.confirmed_cells`).
    The blocks of space in the reach of an arm are searched when the first arm needs them, which takes seconds. The
    folder of the run keeps their cells for later commands. If it cannot be written, each command searches again.

    Args:
        run: folder of the run.
        open_log: opens the log of the run, with the same masks; called if a block is not known.
        model: the map.
        field: collision field of ``model``.

    Raises:
        FormatError: the folder is damaged.
    """

    def __init__(
        self, run: RunFolder, open_log: Callable[[], Log], model: GaussianModel, field: GaussianCollisionField
    ) -> None:
        self._run, self._open_log, self._field = run, open_log, field
        self._lock = threading.Lock()
        self._kept = KeptSurface(np.zeros((0, 3), np.int32), np.zeros((0, 3), np.int32))
        self._key = _key(run, model, field)
        with suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # none, or not of this map
            self._kept = _load(run, self._key)

    def near(self, arm: RobotSpheres) -> Array:
        """Return the spheres in the reach of an arm: (M, 4) centers [m, world] and radii [m].

        Raises:
            FormatError: the folder is damaged.
            LogError: the log is damaged.
        """
        center, reach = arm.T_world_base[:3, 3], min(arm.reach_radius, CONSTANTS.farthest)
        with self._lock:
            missing = _without(blocks_within(center, reach), self._kept.blocks)
            if len(missing):
                found = self._search(missing)
                self._kept = KeptSurface(
                    np.concatenate([self._kept.blocks, missing]), np.concatenate([self._kept.cells, found])
                )
                with suppress(OSError):  # as of a full disk
                    _save(self._run, self._key, self._kept)
            cells = self._kept.cells
        centers, radius = (cells + 0.5) * CONSTANTS.cell, np.sqrt(3) / 2 * CONSTANTS.cell
        near = centers[np.linalg.norm(centers - center, axis=1) - radius < reach]
        return np.c_[near, np.full(len(near), radius)]

    def _search(self, blocks: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the cells (C, 3) of blocks (B, 3) with a confirmed point outside of the map."""
        first, sensor = blocks.min(axis=0), self._run.load_config().sensor
        wanted = np.zeros(blocks.max(axis=0) - first + 1, np.bool_)
        wanted[tuple((blocks - first).T)] = True

        def outside(points: Array) -> NDArray[np.bool_]:
            place = np.floor(points / CONSTANTS.block).astype(np.int32) - first
            chosen = np.asarray(((place >= 0) & (place < wanted.shape)).all(axis=1))
            chosen[chosen] = wanted[tuple(place[chosen].T)]
            chosen[chosen] = ~self._field.in_collision(points[chosen])
            return chosen

        cells = confirmed_cells(
            raw_views(self._run, self._open_log(), CONSTANTS.frames)[1],
            first * CONSTANTS.block,
            (first + wanted.shape) * CONSTANTS.block,
            floor=sensor.sigma_depth_floor,
            quad=sensor.sigma_depth_quad,
            edge=CONSTANTS.cell,
            inside=outside,
            agreeing_views=MARGIN.agreeing_views,
        )
        return cells.astype(np.int32)


@dataclass(frozen=True, eq=False)
class KeptSurface:
    """Blocks that were searched, and their cells, as the folder of a run keeps them.

    Args:
        blocks: (B, 3) int32 blocks of space that were searched; block (i, j, k) begins at (i, j, k) edges.
        cells: (C, 3) int32 cells in them with a confirmed point outside of the map.
    """

    blocks: NDArray[np.int32]
    cells: NDArray[np.int32]


def blocks_within(center: Array, reach: float) -> NDArray[np.int32]:
    """Return the blocks (B, 3) that a ball meets.

    Args:
        center: (3,) of the ball [m].
        reach: its radius [m].
    """
    edge = CONSTANTS.block
    low, high = (np.floor((center + side * reach) / edge).astype(np.int32) for side in (-1, 1))
    blocks = np.stack(
        np.meshgrid(*(np.arange(a, b + 1, dtype=np.int32) for a, b in zip(low, high, strict=True)), indexing="ij"), -1
    )
    blocks = blocks.reshape(-1, 3)
    nearest = np.clip(center, blocks * edge, (blocks + 1) * edge)
    return np.asarray(blocks[np.linalg.norm(nearest - center, axis=1) <= reach])


def _without(blocks: NDArray[np.int32], known: NDArray[np.int32]) -> NDArray[np.int32]:
    searched = {tuple(block) for block in known.tolist()}
    return np.array([block for block in blocks.tolist() if tuple(block) not in searched], np.int32).reshape(-1, 3)


def _key(run: RunFolder, model: GaussianModel, field: GaussianCollisionField) -> str:
    """Return a digest of all inputs of the search: map, gates, poses, sensor and constants."""
    digest = hashlib.sha256()
    for values in (model.means, model.quats, model.log_scales, model.opacity_logits, model.observations):
        digest.update(np.ascontiguousarray(values.detach().numpy()).tobytes())
    for index, pose in sorted(run.load_poses().items()):
        digest.update(f"{index} {pose.tolist()}".encode())
    settings = (field.n_sigma, astuple(field.gate), run.load_config().to_yaml(), astuple(CONSTANTS), astuple(MARGIN))
    digest.update(repr(settings).encode())
    return digest.hexdigest()


def _digest(kept: KeptSurface) -> str:
    return hashlib.sha256(kept.blocks.tobytes() + b"cells" + kept.cells.tobytes()).hexdigest()


def _load(run: RunFolder, key: str) -> KeptSurface:
    """Load the kept surface of a map.

    Raises:
        OSError: it keeps nothing, or cannot be read.
        ValueError: it is of another map, or damaged.
        KeyError, EOFError, zipfile.BadZipFile: the file is damaged.
    """
    with np.load(run.measured, allow_pickle=False) as file:
        if str(file["key"]) != key:
            raise ValueError("is of another map")
        kept, digest = KeptSurface(file["blocks"], file["cells"]), file["digest"]
    if any(values.dtype != np.int32 or values.shape[1:] != (3,) for values in (kept.blocks, kept.cells)):
        raise ValueError("has other arrays")
    if str(digest) != _digest(kept):
        raise ValueError("is damaged")
    return kept


def _save(run: RunFolder, key: str, kept: KeptSurface) -> None:
    with atomic_write(run.measured) as file:
        np.savez(file, key=np.array(key), digest=np.array(_digest(kept)), blocks=kept.blocks, cells=kept.cells)
