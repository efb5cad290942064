"""A map on disk, of which only the tiles that a query needs are in memory."""

from __future__ import annotations

import hashlib
import heapq
import os
import stat
import threading
import weakref
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField
from splatbot.collision.solids import SCALE_FLOOR
from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.tiles.field import TiledField, checked_box
from splatbot.tiles.fields import FieldCache
from splatbot.tiles.index import DATA_NAME, GIVE_TILES, WRITE_AGAIN, Tile, TileIndex, read_index
from splatbot.tiles.part import MapPart, bytes_each, decode

Numbers = NDArray[np.int64]
Point = tuple[float, ...]


@dataclass(frozen=True)
class TiledMapConstants:
    """Constants of tiled maps.

    Args:
        memory_mb: default of the memory of tiles, of shared fields, and of the largest answer.
        lattice: [m] edge of the cells that the box of a shared field consists of.
        pixel_error: default of the largest edge of a cell of merged Gaussians in a view [px].
        slack: share by which ellipsoids grow in queries, for the rounding of a field.
        box_slack: share of its diagonal and of its largest coordinate by which a box grows, for the same.
        scale_slack: share by which a standard deviation may exceed the bound of its tile, for the rounding of exp.
        sigmas: standard deviations that the rasterizer draws.
        near: [m] nearest Gaussian that it draws.
        blur: [px²] that it adds to projected variances.
        fov_margin: share of half the image beyond which it clamps the slope of the projection.
    """

    memory_mb: float = 24.0
    lattice: float = 0.5
    pixel_error: float = 1.0
    slack: float = 1e-4
    box_slack: float = 4e-6
    scale_slack: float = 1e-6
    sigmas: float = 3.34
    near: float = 0.01
    blur: float = 0.3
    fov_margin: float = 0.3


CONSTANTS = TiledMapConstants()
_RESTORE = "restore it from a copy, or write the tiled map again"


@dataclass(frozen=True)
class TileCover:
    """Tiles that cover a view.

    Args:
        numbers: of the tiles in the index; none of them is an ancestor of another.
        pixel_error: largest edge of a cell of merged Gaussians in the view [px]; larger than requested if the memory
            does not suffice.
    """

    numbers: tuple[int, ...]
    pixel_error: float


@dataclass(frozen=True, eq=False)
class TiledView:
    """Gaussians for a view.

    Args:
        model: they draw the view.
        rows: (M,) int32, row of each in the map; of a merged Gaussian, that of its first member.
        pixel_error: largest edge of a cell of merged Gaussians in the view [px]; larger than requested if the memory
            does not suffice.
        tiles: number of tiles in use.
    """

    model: GaussianModel
    rows: torch.Tensor
    pixel_error: float
    tiles: int


class TileMemoryError(InputError):
    """The tiles of a query, or the largest tile, exceed the memory."""


class TiledMap:
    """A map in a folder that `splatbot tile` wrote; any number of threads may query it.

    Tiles are read when a query needs them. The latest ones stay in memory, up to ``memory_mb``. Shared fields take at
    most as much again, and so does an answer of Gaussians. The file is closed with the last reference to the map.

    Args:
        folder: of the tiled map.
        memory_mb: largest memory of tiles, and of shared fields [MB].

    Raises:
        FormatError: the index is missing or damaged, or the data does not have its size.
        TileMemoryError: the memory is too small for a tile.
    """

    def __init__(self, folder: str | Path, *, memory_mb: float = CONSTANTS.memory_mb) -> None:
        self.folder = Path(folder)
        self.index: TileIndex = read_index(self.folder)
        self.loads, self.hits = 0, 0
        self._bytes_each = bytes_each(self.index.sh_terms)
        self._starts = self.index.starts
        self._most = int(memory_mb * 1e6 / self._bytes_each) if 0 < memory_mb < np.inf else 0
        self._cache: OrderedDict[int, MapPart] = OrderedDict()
        self.fields = FieldCache(memory_mb * 1e6)
        self._lock = threading.Lock()
        tiles = self.index.tiles
        self._counts = np.array([tile.count for tile in tiles], np.int64)
        low, high, scales = _nested_bounds(tiles)
        self._low, self._high = (np.array(corners, np.float64).reshape(-1, 3) for corners in (low, high))
        self._scales = np.maximum(scales, SCALE_FLOOR)
        self._leaves = np.array([not tile.children for tile in tiles], np.bool_)
        if self._most < self._counts.max(initial=1):
            least = self._counts.max(initial=1) * self._bytes_each / 1e6
            raise TileMemoryError(f"is {memory_mb:g} MB.", field="memory_mb", hint=f"give {least:.3g} or more")
        self._file = _open(self.folder / DATA_NAME, self._starts[-1] * self._bytes_each)
        self._close_file = weakref.finalize(self, os.close, self._file)

    def close(self) -> None:
        """Close the file of the tiles; later queries of tiles raise an OSError."""
        self.fields.clear()
        with self._lock:
            self._cache.clear()
            self._close_file()
            self._file = -1

    def __enter__(self) -> TiledMap:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return self.index.gaussians

    @property
    def nbytes(self) -> int:
        """Bytes of the tiles and of the shared fields in memory."""
        with self._lock:
            return sum(part.nbytes for part in self._cache.values()) + self.fields.nbytes

    @property
    def box(self) -> tuple[Array, Array]:
        """Corners (3,) of the box of all means [m, world]; of a map with Gaussians."""
        return self._low[self._leaves].min(axis=0), self._high[self._leaves].max(axis=0)

    @property
    def most_in_view(self) -> int:
        """Largest number of Gaussians of a view: those of the memory."""
        return self._most

    def coarsest(self) -> TileCover:
        """Return the cover of every view: the root of the tree, or no tile of an empty map."""
        return TileCover(tuple(range(len(self.index.tiles)))[-1:], np.inf)

    def overview(self) -> GaussianModel:
        """Return the Gaussians of the coarsest level."""
        return self._union(self.coarsest().numbers).model

    def tile(self, number: int) -> GaussianModel:
        """Return the Gaussians of a tile.

        Raises:
            FormatError: the tile is damaged.
        """
        return self._load(number).model

    def near(self, low: ArrayLike, high: ArrayLike, n_sigma: float = 2.0) -> MapPart:
        """Return all Gaussians whose ellipsoids may reach into a box, in the order of the map.

        Args:
            low, high: (3,) corners of the box [m, world].
            n_sigma: standard deviations at which the surface of a Gaussian lies.

        Raises:
            InputError: the box or n_sigma is invalid.
            TileMemoryError: the tiles of the box exceed the memory.
            FormatError: a tile is damaged.
        """
        box = _enlarged(checked_box(low, high))
        if not 0.0 <= n_sigma < np.inf:
            raise InputError(f"is {n_sigma}.", field="n_sigma", hint="give standard deviations, 0 or more")
        reach = n_sigma * (1.0 + CONSTANTS.slack)
        found = np.flatnonzero(self._leaves & _meets(box, self._low, self._high, reach * self._scales))
        count = int(self._counts[found].sum())
        if count > self._most:
            used, limit = count * self._bytes_each / 1e6, self._most * self._bytes_each / 1e6
            hint = "give a smaller box, or more memory_mb"
            raise TileMemoryError(f"needs {used:.3g} MB, at most {limit:.3g} MB are allowed.", field="box", hint=hint)
        parts = [MapPart.empty(self.index.sh_degree)]
        for number in found.tolist():
            part = self._load(number)
            parts.append(part.select(torch.from_numpy(_rows_near(box, part, reach, float(self._scales[number])))))
        return MapPart.union(parts)

    def field(self, low: ArrayLike, high: ArrayLike, n_sigma: float = 2.0, *, reach: float = 0.0) -> TiledField:
        """Return the collision field of a box; its answers inside the box are those of the whole map.

        Args:
            low, high: (3,) corners of the box [m, world].
            n_sigma: standard deviations at which the surface of a Gaussian lies.
            reach: largest distance that the field measures [m].

        Raises:
            InputError: see :meth:`near` and :class:`splatbot.collision.GaussianCollisionField`; or the reach is
                negative or not finite.
        """
        box = checked_box(low, high)
        if not 0.0 <= reach < np.inf:
            raise InputError(f"is {reach}.", field="reach", hint="give metres, 0 or more")
        part = self.near(box[0] - reach, box[1] + reach, n_sigma)
        return TiledField(GaussianCollisionField(part.model, n_sigma), part.rows.numpy(), box[0], box[1], reach)

    def shared_field(self, low: ArrayLike, high: ArrayLike, n_sigma: float = 2.0, *, reach: float = 0.0) -> TiledField:
        """Return the field of the cells of a lattice that a box meets; the next box in the same cells has the same one.

        Args:
            low, high, n_sigma, reach: see :meth:`field`.

        Raises:
            InputError: see :meth:`field`.
        """
        first, last = (corner - np.mod(corner, CONSTANTS.lattice) for corner in checked_box(low, high))
        key = (tuple(first.tolist()), tuple((last + CONSTANTS.lattice).tolist()), n_sigma, reach)
        return self.fields.get(key, lambda: self.field(key[0], key[1], n_sigma, reach=reach))

    def in_view(
        self, camera: Camera, T_world_camera: ArrayLike, *, pixel_error: float = CONSTANTS.pixel_error
    ) -> TiledView:
        """Return the Gaussians that draw a view: those of its :meth:`cover`, with the same arguments.

        Raises:
            InputError: the error is negative or not finite, or the pose is not (4, 4) and finite.
            FormatError: a tile is damaged.
        """
        cover = self.cover(camera, T_world_camera, pixel_error=pixel_error)
        part = self._union(cover.numbers)
        return TiledView(part.model, part.rows, cover.pixel_error, len(cover.numbers))

    def cover(
        self, camera: Camera, T_world_camera: ArrayLike, *, pixel_error: float = CONSTANTS.pixel_error
    ) -> TileCover:
        """Choose the tiles that draw a view, without reading them.

        From the root on, the tile of the largest error is replaced by its children in view. This ends when all errors
        are small enough, or when the memory is used. The error of a tile is the edge of its cells at the nearest depth
        of its box. With ``pixel_error`` 0, the view equals that of the whole map.

        Args:
            camera: pinhole camera.
            T_world_camera: (4, 4) rigid [m].
            pixel_error: largest edge of a cell of merged Gaussians [px].

        Raises:
            InputError: the error is negative or not finite, or the pose is not (4, 4) and finite.
        """
        if not 0.0 <= pixel_error < np.inf:
            raise InputError(f"is {pixel_error}.", field="pixel_error", hint="give pixels, 0 or more")
        pose = np.asarray(T_world_camera, dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise InputError(f"is {pose.shape} or not finite.", field="T_world_camera", hint="give a rigid (4, 4)")
        visible, depths = self._visible(camera, inverse(pose))
        errors = max(camera.fx, camera.fy) * np.array([tile.error for tile in self.index.tiles]) / depths
        chosen, reached = self._refined(visible, errors, pixel_error)
        return TileCover(tuple(chosen), reached)

    def _union(self, numbers: Sequence[int]) -> MapPart:
        return MapPart.union([MapPart.empty(self.index.sh_degree), *(self._load(number) for number in numbers)])

    def _refined(self, visible: NDArray[np.bool_], errors: Array, most: float) -> tuple[list[int], float]:
        """Return tiles that cover the view at an error [px] of at most ``most``, or at the least that memory allows."""
        root = len(self.index.tiles) - 1
        heap = [(-float(errors[root]), root)] if root >= 0 and visible[root] else []
        count = sum(int(self._counts[number]) for _, number in heap)
        while heap and -heap[0][0] > most:
            number = heap[0][1]
            children = [child for child in self.index.tiles[number].children if visible[child]]
            count += int(self._counts[children].sum() - self._counts[number])
            if count > self._most:
                break
            heapq.heappop(heap)
            for child in children:
                heapq.heappush(heap, (-float(errors[child]), child))
        return sorted(number for _, number in heap), -heap[0][0] if heap else 0.0

    def _visible(self, camera: Camera, T_camera_world: Array) -> tuple[NDArray[np.bool_], Array]:
        """Return the tiles (T,) in which the rasterizer may draw a Gaussian, and their nearest depths (T,) [m].

        A Gaussian of depth z and standard deviation s has a radius of at most sigmas (f s k / z + blur) [px]. Here k is
        the length of the steepest ray (x / z, y / z, 1). So it meets the left edge of the image if its mean is in the
        half-space f x + (c + margin) z + sigmas f s k >= 0. Other edges are similar.
        """
        ends = np.stack([self._low, self._high], axis=1)
        corners = np.stack([ends[:, [i & 1, i >> 1 & 1, i >> 2], [0, 1, 2]] for i in range(8)], axis=1)
        x, y, z = np.moveaxis(transform_points(T_camera_world, corners), -1, 0)
        visible = z.max(axis=1) >= CONSTANTS.near
        pixels = 1.0 + CONSTANTS.sigmas * np.sqrt(CONSTANTS.blur)
        axes = ((x, camera.fx, camera.cx + 0.5, camera.width), (y, camera.fy, camera.cy + 0.5, camera.height))
        slopes = [(max(abs(c), abs(size - c)) + CONSTANTS.fov_margin * size) / f for _, f, c, size in axes]
        reach = CONSTANTS.sigmas * float(np.sqrt(1.0 + slopes[0] ** 2 + slopes[1] ** 2)) * self._scales
        for along, f, c, size in axes:
            visible &= (f * along + (c + pixels) * z).max(axis=1) + f * reach >= 0.0
            visible &= (f * along + (c - size - pixels) * z).min(axis=1) - f * reach <= 0.0
        return visible, np.maximum(z.min(axis=1), CONSTANTS.near)

    def _load(self, number: int) -> MapPart:
        """Return the Gaussians of a tile; the least recently used tiles leave the memory for it.

        Raises:
            FormatError: the tile is damaged.
        """
        with self._lock:
            if number in self._cache:
                self.hits += 1
                self._cache.move_to_end(number)
                return self._cache[number]
            room = self._most - int(self._counts[number])
            while self._counts[list(self._cache)].sum() > room:
                self._cache.popitem(last=False)
            self.loads += 1
            part = decode(self._read(number), self.index.sh_terms)
            self._check(part, number)
            self._cache[number] = part
            return part

    def _read(self, number: int) -> bytearray:
        data = bytearray(int(self._counts[number]) * self._bytes_each)
        size = os.preadv(self._file, [data], self._starts[number] * self._bytes_each)
        if size != len(data) or hashlib.sha256(data).hexdigest() != self.index.tiles[number].sha256:
            problem, field = "is damaged: its checksum does not fit.", f"tile {number}"
            raise FormatError(problem, file=self._path, field=field, hint=_RESTORE)
        return data

    def _check(self, part: MapPart, number: int) -> None:
        """Check that Gaussians are finite, within the bounds of their tile, and of rows of the map.

        Raises:
            FormatError: they are not.
        """
        model = part.model
        columns = {column.name: getattr(model, column.name).numpy() for column in fields(model)}
        means, quats, rows = columns["means"], columns["quats"], part.rows.numpy()
        scale = float(np.exp(columns["log_scales"].max(initial=-np.inf).astype(np.float64)))
        low, high = self._low[number], self._high[number]
        problems = {
            "is not finite": any(not np.isfinite(values).all() for values in columns.values()),
            "has a quaternion of zeros": bool((quats[quats[:, 0] == 0] == 0).all(axis=1).any()),
            "leaves its box": any(
                m.min() < least or m.max() > most for m, least, most in zip(means.T, low, high, strict=True)
            ),
            "exceeds its scale": scale > (1.0 + CONSTANTS.scale_slack) * self._scales[number],
            "has rows that the map lacks": rows.min() < 0 or rows.max() >= self.index.gaussians,
        }
        for problem in (text for text, is_wrong in problems.items() if is_wrong):
            raise FormatError(f"{problem}.", file=self._path, field=f"tile {number}", hint=WRITE_AGAIN)

    @property
    def _path(self) -> Path:
        return self.folder / DATA_NAME


def _nested_bounds(tiles: Sequence[Tile]) -> tuple[list[Point], list[Point], list[float]]:
    """Return low and high corners, and largest standard deviations [m]; those of a parent enclose its children.

    Children come first. Bounds in a file may not be nested.
    """
    low, high, scales = ([getattr(tile, name) for tile in tiles] for name in ("low", "high", "scale"))
    for number, tile in enumerate(tiles):
        if tile.children:
            family = [number, *tile.children]
            low[number] = tuple(map(min, *(low[member] for member in family)))
            high[number] = tuple(map(max, *(high[member] for member in family)))
            scales[number] = max(scales[member] for member in family)
    return low, high, scales


def _enlarged(box: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return a box, enlarged for the rounding of a field to float32."""
    low, high = box
    room = CONSTANTS.box_slack * (np.linalg.norm(high - low) + np.abs(box).max())
    return low - room, high + room


def _rows_near(box: tuple[Array, Array], part: MapPart, reach: float, scale: float) -> Numbers:
    """Return the rows of a tile whose ellipsoids of ``reach`` standard deviations may meet a box.

    Columns are compared with the bound of the tile's largest standard deviation ``scale`` [m] first: few rows remain.
    """
    means, log_scales = part.model.means.numpy(), part.model.log_scales.numpy()
    room = reach * (1.0 + CONSTANTS.scale_slack) * scale
    near = np.ones(len(part), np.bool_)
    for along, low, high in zip(means.T, *box, strict=True):
        near &= (along >= low - room) & (along <= high + room)
    rows = np.flatnonzero(near)
    centres, scales = means[rows].astype(np.float64), np.exp(log_scales[rows].astype(np.float64).max(axis=1))
    return rows[_meets(box, centres, centres, reach * scales.clip(SCALE_FLOOR))]


def _meets(box: tuple[Array, Array], low: Array, high: Array, reach: Array) -> NDArray[np.bool_]:
    """Return whether boxes (N, 3), enlarged by (N,) [m], meet a box."""
    apart = np.maximum(low - box[1], box[0] - high)
    return np.asarray((apart <= reach[:, None]).all(axis=1))


def _open(path: Path, size: int) -> int:
    """Open a file of a known size.

    Raises:
        FormatError: it is no file, cannot be read, or has another size.
    """
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # a pipe would wait for its writer
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint=GIVE_TILES) from error
    found = os.fstat(file)
    if not stat.S_ISREG(found.st_mode) or found.st_size != size:
        os.close(file)
        raise FormatError(f"is no file of {size:,} bytes.", file=path, hint=_RESTORE)
    return file
