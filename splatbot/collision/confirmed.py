"""Confirmed space: surface points that several depth images agree on, and free points that several rays passed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot._native import count_measurements
from splatbot.camera import Camera
from splatbot.collision.visibility import CONSTANTS as VISIBILITY
from splatbot.collision.visibility import DepthView, measured_depths, passing_distance
from splatbot.errors import InputError
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array


@dataclass(frozen=True)
class ConfirmedConstants:
    """Constants of confirmed space.

    Args:
        points_per_view: largest number of surface points, and of free points, that one view proposes. The work is this
            times the square of the number of views.
        agreement_sigma: [σ of depth] largest difference of two measurements of one surface point.
        agreeing_views: number of other views that confirm a surface point.
        through_share: largest share of the views of a surface point whose ray passes it.
        passing_views: number of other views whose rays confirm a free point.
        free_range: range of the position of a free point along its ray [share of depth].
    """

    points_per_view: int = 5000
    agreement_sigma: float = 3.0
    agreeing_views: int = 2
    through_share: float = 0.1
    passing_views: int = 3
    free_range: tuple[float, float] = (0.2, 0.97)


CONSTANTS = ConfirmedConstants()


@dataclass(frozen=True, eq=False)
class ConfirmedSpace:
    """Points that several depth images agree on.

    Args:
        surface: (S, 3) surface points [m, world].
        depth: (S,) depth of each of them in the view that proposed it [m].
        view: (S,) int64, index of that view.
        pixel: (S, 2) int64, column and row of the point in that view.
        free: (F, 3) points in free space [m, world].
        proposed: number of surface points before confirmation.
    """

    surface: Array
    depth: Array
    view: NDArray[np.int64]
    pixel: NDArray[np.int64]
    free: Array
    proposed: int

    def select(self, chosen: NDArray[np.bool_]) -> ConfirmedSpace:
        """Return the chosen (S,) surface points, with all free points."""
        kept = (self.surface[chosen], self.depth[chosen], self.view[chosen], self.pixel[chosen])
        return ConfirmedSpace(*kept, self.free, self.proposed)


def find_confirmed(
    views: Sequence[DepthView], *, floor: float, quad: float, agreeing_views: int = CONSTANTS.agreeing_views
) -> ConfirmedSpace:
    """Find confirmed space by comparing points of every view with all other views.

    A pixel of a view proposes a surface point. It is confirmed if two other views measure the same depth there within
    3 σ, with σ = ``floor`` + ``quad`` z². At most a tenth of the views that measure depth there may see through it.
    A ray proposes a free point in front of its surface. It is confirmed if three other views see through it and none
    measures a surface there. The pixels are evenly spaced and the result is deterministic.

    Args:
        views: depth (H, W) [m], 0 or NaN where invalid, camera, and T_world_camera (4, 4) of each view.
        floor: constant part of the standard deviation σ of depth [m].
        quad: part of σ that grows with z² [1/m].
        agreeing_views: number of other views that confirm a surface point.

    Raises:
        InputError: the size of a depth image differs from its camera's.
    """
    surfaces, frees, depths, owners, pixels, counts = [], [], [], [], [], []
    for number, (depth, camera, T_world_camera) in enumerate(views):
        if depth.shape != (camera.height, camera.width):
            raise InputError(f"is {depth.shape}.", field="depth", hint=f"give ({camera.height}, {camera.width})")
        column, row, z = _spread_pixels(depth, number)
        shares = _shares(len(z))
        surfaces.append(_lifted(column, row, z, camera, T_world_camera))
        frees.append(_lifted(column, row, z * shares, camera, T_world_camera))
        depths.append(z)
        owners.append(np.full(len(z), number))
        pixels.append(np.stack([column, row], axis=1))
        counts.append(len(z))
    if not sum(counts):
        return ConfirmedSpace(
            np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 2), np.int64), np.zeros((0, 3)), 0
        )
    surface, free, z, owner = (np.concatenate(parts) for parts in (surfaces, frees, depths, owners))
    pixel = np.concatenate(pixels)
    agreeing, clear = _agreeing(surface, owner, views, floor, quad)
    solid = clear & (agreeing >= agreeing_views)
    empty = _passed(free, owner, views)
    return ConfirmedSpace(surface[solid], z[solid], owner[solid], pixel[solid], free[empty], len(surface))


def confirmed_near(
    views: Sequence[DepthView],
    low: Array,
    high: Array,
    *,
    floor: float,
    quad: float,
    spacing: float,
    most: int,
    agreeing_views: int = CONSTANTS.agreeing_views,
    T_world_box: Array | None = None,
    inside: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> Array:
    """Find the confirmed surface points (S, 3) [m, world] of a box, from all pixels that measure in it.

    The rule of confirmation is that of :func:`find_confirmed`.

    Args:
        views: depth (H, W) [m], 0 or NaN where invalid, camera, and T_world_camera (4, 4) of each view.
        low, high: (3,) corners of the box in its frame [m].
        floor, quad: σ = ``floor`` + ``quad`` z² of depth, in [m] and [1/m].
        spacing: edge of the voxels in which each view proposes at most one point [m].
        most: largest number of proposed points, evenly spaced among all; it bounds the work.
        agreeing_views: number of other views that confirm a surface point.
        T_world_box: (4, 4) frame of the box. If None, the world.
        inside: selects the points (P, 3) [m, frame of the box] of a smaller volume in the box. If None, all of them.
    """
    T = np.eye(4) if T_world_box is None else T_world_box
    found, owners = [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for number, (depth, camera, T_world_camera) in enumerate(views):
        T_box_camera = inverse(T) @ T_world_camera
        row, column = _pixels_in_box(depth, low, high, camera, T_box_camera)
        local = _lifted(column, row, depth[row, column].astype(np.float64), camera, T_box_camera)
        chosen = np.asarray(((local > low) & (local < high)).all(axis=1))
        if inside is not None:
            chosen[chosen] = inside(local[chosen])
        local = local[chosen]
        cell = np.floor((local - low) / spacing).astype(np.int64) @ [1, 1 << 20, 1 << 40]
        first = np.unique(cell, return_index=True)[1]
        found.append(transform_points(T, local[np.sort(first)]))
        owners.append(np.full(len(first), number))
    proposed, owner = np.concatenate(found), np.concatenate(owners)
    some = np.linspace(0, len(proposed) - 1, min(most, len(proposed))).round().astype(np.int64)
    agreeing, clear = _agreeing(proposed[some], owner[some], views, floor, quad)
    return np.asarray(proposed[some][clear & (agreeing >= agreeing_views)])


def confirmed_cells(
    views: Sequence[DepthView],
    low: Array,
    high: Array,
    *,
    floor: float,
    quad: float,
    edge: float,
    inside: Callable[[Array], NDArray[np.bool_]],
    agreeing_views: int = CONSTANTS.agreeing_views,
) -> NDArray[np.int64]:
    """Find the cells (C, 3) of a grid in which a point is confirmed; cell (i, j, k) begins at (i, j, k) · ``edge``.

    The rule of confirmation is that of :func:`find_confirmed`. Each view proposes one point for each eighth of a cell
    that no earlier view has confirmed. The work is at most the number of pixels times that of views.

    Args:
        views: depth (H, W) [m], 0 or NaN where invalid, camera, and T_world_camera (4, 4) of each view.
        low, high: (3,) corners of a box around the points that count [m, world].
        floor, quad: σ = ``floor`` + ``quad`` z² of depth, in [m] and [1/m].
        edge: of a cell [m].
        inside: selects the points (P, 3) [m, world] that count.
        agreeing_views: number of other views that confirm a surface point.
    """
    origin = np.floor(low / edge).astype(np.int64) - 1
    known = np.zeros(0, np.int64)
    for number, (depth, camera, T_world_camera) in enumerate(views):
        row, column = _pixels_in_box(depth, low, high, camera, T_world_camera)
        points = _lifted(column, row, depth[row, column].astype(np.float64), camera, T_world_camera)
        points = points[~_in_sorted(_codes(points, origin, edge), known)]
        points = points[inside(points)]
        points = points[np.unique(_codes(points, 2 * origin, edge / 2), return_index=True)[1]]
        agreeing, clear = _agreeing(points, np.full(len(points), number), views, floor, quad)
        confirmed = _codes(points[clear & (agreeing >= agreeing_views)], origin, edge)
        known = np.sort(np.concatenate([known, confirmed]), kind="stable")  # fast, as most of it is sorted
        known = known[np.diff(known, prepend=-1) > 0]
    return np.stack([(known >> shift) & _AXIS for shift in _SHIFTS], axis=1) + origin


_SHIFTS = (42, 21, 0)  # bits of the axes in the code of a cell
_AXIS = (1 << 21) - 1


def _codes(points: Array, origin: NDArray[np.int64], edge: float) -> NDArray[np.int64]:
    """Return one number for the cell of each point (P,); cells are counted from ``origin`` (3,)."""
    x, y, z = (np.floor(points / edge).astype(np.int64) - origin).T
    return np.asarray(x << _SHIFTS[0] | y << _SHIFTS[1] | z, dtype=np.int64)


def _in_sorted(values: NDArray[np.int64], known: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether each value (P,) is among the sorted ones."""
    if not len(known):
        return np.zeros(len(values), np.bool_)
    return np.asarray(known[np.minimum(np.searchsorted(known, values), len(known) - 1)] == values)


def _pixels_in_box(
    depth: NDArray[np.float32], low: Array, high: Array, camera: Camera, T_box_camera: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns of the pixels that measure in a box, or within 0.1 mm of it.

    A pixel (u, v) with depth z lies at z (a u + b v + c) + t in the frame of the box. One axis of all pixels needs a
    row and a column, in float32.
    """
    columns, rows = _pixel_window(low, high, camera, T_box_camera)
    part = depth[rows, columns]
    x = (np.arange(columns.start, columns.stop) - camera.cx) / camera.fx
    y = (np.arange(rows.start, rows.stop) - camera.cy) / camera.fy
    within = part > 0
    for axis in range(3):
        a, b, c, t = T_box_camera[axis]
        direction = (a * x).astype(np.float32)[None] + (b * y + c).astype(np.float32)[:, None]
        p = part * direction
        within &= (p > np.float32(low[axis] - t - 1e-4)) & (p < np.float32(high[axis] - t + 1e-4))
    row, column = np.nonzero(within)
    return row + rows.start, column + columns.start


def _pixel_window(low: Array, high: Array, camera: Camera, T_box_camera: Array) -> tuple[slice, slice]:
    """Return the columns and rows of an image that can show a box; all of them if the box reaches the camera."""
    corners = np.array([[(low, high)[bit][axis] for axis, bit in enumerate(bits)] for bits in np.ndindex(2, 2, 2)])
    p = transform_points(inverse(T_box_camera), corners)
    if (p[:, 2] < 0.05).all():
        return slice(0, 0), slice(0, 0)
    if (p[:, 2] < 0.05).any():
        return slice(0, camera.width), slice(0, camera.height)
    u, v = camera.fx * p[:, 0] / p[:, 2] + camera.cx, camera.fy * p[:, 1] / p[:, 2] + camera.cy
    left, right = np.clip([u.min() - 1, u.max() + 2], 0, camera.width).astype(int)
    top, bottom = np.clip([v.min() - 1, v.max() + 2], 0, camera.height).astype(int)
    return slice(left, right), slice(top, bottom)


def _spread_pixels(
    depth: NDArray[np.float32], number: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return columns, rows and depths (P,) [m] of evenly spaced pixels with depth; views differ in their offset."""
    row, column = np.nonzero(np.isfinite(depth) & (depth > 0))
    count = min(len(row), CONSTANTS.points_per_view)
    offset = (number * 0.618034) % 1.0  # golden ratio: neighbouring views sample other pixels
    some = ((np.arange(count) + offset) * (len(row) / max(count, 1))).astype(np.int64)
    return column[some], row[some], depth[row[some], column[some]].astype(np.float64)


def _shares(count: int) -> Array:
    low, high = CONSTANTS.free_range
    return np.asarray(low + (high - low) * ((np.arange(count) * 0.618034) % 1.0), dtype=np.float64)


def _lifted(column: NDArray[np.int64], row: NDArray[np.int64], z: Array, camera: Camera, T: Array) -> Array:
    ray = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(z))], axis=1)
    return transform_points(T, ray * z[:, None])


def _agreeing(
    points: Array, owner: NDArray[np.int64], views: Sequence[DepthView], floor: float, quad: float
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Return how many other views measure each point (P,), and whether hardly any sees through it (P,)."""
    points, owner, counts = np.ascontiguousarray(points), owner.astype(np.int32), np.zeros((len(points), 3), np.int32)
    for number, (depth, camera, T_world_camera) in enumerate(views):
        count_measurements(
            np.ascontiguousarray(depth, dtype=np.float32),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            np.ascontiguousarray(inverse(T_world_camera)),
            points,
            owner,
            view=number,
            agreement=(CONSTANTS.agreement_sigma * floor, CONSTANTS.agreement_sigma * quad),
            passage=(VISIBILITY.depth_tolerance, VISIBILITY.depth_tolerance_per_z2),
            counts=counts,
        )
    agreeing, passing, measuring = counts.T
    return agreeing, passing <= CONSTANTS.through_share * measuring


def _passed(points: Array, owner: NDArray[np.int64], views: Sequence[DepthView]) -> NDArray[np.bool_]:
    passing, stopped = np.zeros(len(points), np.int32), np.zeros(len(points), np.bool_)
    for number, view in enumerate(views):
        rows, measured, own = measured_depths(points, *view)
        distance = passing_distance(own)
        stopped[rows[np.abs(measured - own) <= distance]] = True
        passing[rows[(measured - own > distance) & (owner[rows] != number)]] += 1
    return (passing >= CONSTANTS.passing_views) & ~stopped
