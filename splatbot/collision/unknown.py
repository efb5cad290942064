"""Unknown space, which no depth image has observed; the caller treats it as free, as suspect or as occupied."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.collision.inputs import rows
from splatbot.collision.visibility import DepthView
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array

UnknownPolicy = Literal["free", "cautious", "occupied"]
"""Treatment of unknown space: free; suspect voxels are obstacles; all unknown voxels are obstacles."""


@dataclass(frozen=True)
class UnknownConstants:
    """Constants of the search for unknown space.

    Args:
        suspect_views: number of views whose pixels of a voxel lack depth that make it suspect.
        suspect_share: least share of the pixels of a voxel without depth in such a view.
        suspect_ratio: least ratio of such views to all views of the voxel, because a sensor's random holes affect few.
        radii: [px] half the sides of the squares of pixels that are tested. A voxel that covers more pixels is too
            close to the camera.
        scattered: [px] groups of so few pixels without depth are noise, and take the least depth around them.
        block: [voxels] edge of the blocks of which those outside of an image are skipped; affects only the time.
    """

    suspect_views: int = 2
    suspect_share: float = 0.1
    suspect_ratio: float = 1 / 3
    radii: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 17, 20, 24, 29, 35, 42, 50, 60)
    scattered: int = 3
    block: int = 8


CONSTANTS = UnknownConstants()


@dataclass(frozen=True, eq=False)
class UnknownSpace:
    """Voxels of a box that no depth image has observed to be empty.

    A caller ignores this class to treat unknown space as free. To treat it as occupied, append :meth:`solids` to the
    map (``GaussianModel.concatenate``) before the field is built. To treat it as a cost, query a separate field of
    :meth:`solids`.

    Args:
        unknown: (X, Y, Z), True where unknown.
        suspect: (X, Y, Z), True where unknown and views measure no depth, as at dark, thin, shiny or transparent
            objects. These are at least two views, and a third of all that look there. Space behind surfaces and outside
            of all images is not suspect.
        origin: (3,) corner of the first voxel [m, world].
        voxel: edge length [m].
    """

    unknown: NDArray[np.bool_]
    suspect: NDArray[np.bool_]
    origin: Array
    voxel: float

    def at(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return whether points (P, 3) [m, world] lie in unknown space; space outside the box is unknown."""
        p = rows(np.asarray(points), "points", 3, "world coordinates in metres")
        cell = np.floor((p - self.origin) / self.voxel).astype(np.int64)
        inside = ((cell >= 0) & (cell < self.unknown.shape)).all(axis=1)
        found = np.ones(len(p), np.bool_)
        found[inside] = self.unknown[tuple(cell[inside].T)]
        return found

    def without(self, spheres: ArrayLike) -> UnknownSpace:
        """Return the same space without the voxels whose enclosing spheres meet any of the spheres (S, 4).

        Args:
            spheres: (S, 4) = (x, y, z, radius) [m, world], which are known to be free or filled by the robot.
        """
        unknown, suspect = self.unknown.copy(), self.suspect.copy()
        for x, y, z, radius in rows(np.asarray(spheres), "spheres", 4, "metres (x, y, z, radius)"):
            reach = radius + np.sqrt(3) / 2 * self.voxel
            center = (np.array([x, y, z]) - self.origin) / self.voxel - 0.5  # [voxels]
            first = np.maximum(np.floor(center - reach / self.voxel), 0).astype(np.int64)
            last = np.minimum(np.ceil(center + reach / self.voxel) + 1, unknown.shape).astype(np.int64)
            if (first >= last).any():
                continue
            i, j, k = (np.arange(low, high) - at for low, high, at in zip(first, last, center, strict=True))
            met = i[:, None, None] ** 2 + j[:, None] ** 2 + k**2 < (reach / self.voxel) ** 2
            part = tuple(slice(low, high) for low, high in zip(first, last, strict=True))
            unknown[part] &= ~met
            suspect[part] &= ~met
        return UnknownSpace(unknown, suspect, self.origin, self.voxel)

    def solids(self, n_sigma: float = 2.0, *, rim: bool = True, policy: UnknownPolicy = "occupied") -> GaussianModel:
        """Return spheres that enclose the voxels of a policy, as Gaussians whose surface is at ``n_sigma``.

        With ``rim`` only voxels with a neighbour of another kind are returned. A motion that starts outside cannot
        reach the interior without passing the rim.
        """
        chosen = {"free": np.zeros_like(self.unknown), "cautious": self.suspect, "occupied": self.unknown}[policy]
        outside = np.pad(~chosen, 1, constant_values=False)
        has_outside_neighbour = np.zeros_like(chosen)
        for shift in np.ndindex(3, 3, 3):
            i, j, k = shift
            x, y, z = chosen.shape
            has_outside_neighbour |= outside[i : i + x, j : j + y, k : k + z]
        cells = np.argwhere(chosen & has_outside_neighbour if rim else chosen)
        n = len(cells)
        return GaussianModel.from_activated(
            means=self.origin + (cells + 0.5) * self.voxel,
            quats=np.tile([1.0, 0, 0, 0], (n, 1)),
            scales=np.full((n, 3), np.sqrt(3) / 2 * self.voxel / n_sigma),
            opacities=np.full(n, 0.99),
            colors=np.full((n, 3), 0.5),
        )


def find_unknown(aabb: ArrayLike, voxel: float, views: Iterable[DepthView]) -> UnknownSpace:
    """Find the voxels of a box that no view has observed to be empty.

    A voxel is empty if one view has depth at all pixels onto which its sphere may project, all of it behind the
    sphere. The test of a single pixel would see past a rod that is thinner than the voxel. The pixels are those of
    the smallest square around the centre that covers the image of the sphere, which is conservative. Up to three
    adjacent pixels without depth are noise of the sensor and take the least depth around them.

    Args:
        aabb: (2, 3) = (low, high), corners of the box [m, world].
        voxel: edge length [m].
        views: depth (H, W) [m], camera, and T_world_camera (4, 4) of each view. Depth is 0 where none was measured, and
            NaN where a mask covers the pixel, such as that of the robot: there the view did not look.

    Raises:
        InputError: the box is empty, or the voxel is not above 0.
    """
    low, high = rows(np.asarray(aabb, dtype=np.float64), "aabb", 3, "corners in metres")[:2]
    if not (voxel > 0 and (high > low).all()):
        raise InputError(
            f"is {low.tolist()}..{high.tolist()} in {voxel} m.", field="aabb", hint="give low < high, voxel > 0"
        )
    size = np.ceil((high - low) / voxel - 1e-9).astype(np.int64)
    radius, views = np.sqrt(3) / 2 * voxel, list(views)
    corners, in_image = _blocks(low, size, voxel, views)
    in_block = np.moveaxis(np.indices((CONSTANTS.block,) * 3), 0, -1).reshape(1, -1, 3)
    cells = (corners[:, None] + in_block).reshape(-1, 3).astype(np.int32)
    open_ = np.zeros(len(cells), np.bool_)
    missing, looks = np.zeros(len(cells), np.int32), np.zeros(len(cells), np.int32)
    for view, met in zip(views, in_image, strict=True):
        left = np.flatnonzero(~open_ & np.repeat(met, CONSTANTS.block**3))
        empty, looked, lacks_depth = _observed(cells[left] * voxel + low + voxel / 2, radius, view)
        open_[left[empty]] = True
        looks[left[looked]] += 1
        missing[left[lacks_depth]] += 1
    inside = (cells < size).all(axis=1)  # the last blocks extend beyond the box
    cells, open_ = cells[inside], open_[inside]
    often = (missing >= CONSTANTS.suspect_views) & (missing >= CONSTANTS.suspect_ratio * looks)
    unknown, suspect = np.ones(tuple(size), np.bool_), np.zeros(tuple(size), np.bool_)
    unknown[tuple(cells.T)] = ~open_
    suspect[tuple(cells.T)] = ~open_ & often[inside]
    return UnknownSpace(unknown, suspect, low, float(voxel))


def _blocks(
    low: Array, size: NDArray[np.int64], voxel: float, views: Sequence[DepthView]
) -> tuple[NDArray[np.int64], list[NDArray[np.bool_]]]:
    """Return the first cells (B, 3) of the blocks of voxels that any view shows, and which (B,) of them each shows."""
    blocks = -(-size // CONSTANTS.block)
    corners = np.moveaxis(np.indices(tuple(blocks.tolist())), 0, -1).reshape(-1, 3) * CONSTANTS.block
    edge = CONSTANTS.block * voxel
    in_image = [_in_image(corners * voxel + low + edge / 2, np.sqrt(3) / 2 * edge, view) for view in views]
    shown = np.any(in_image, axis=0) if in_image else np.zeros(len(corners), np.bool_)
    return corners[shown], [met[shown] for met in in_image]


def _in_image(centers: Array, radius: float, view: DepthView) -> NDArray[np.bool_]:
    """Return whether spheres (P,) of a radius [m] meet the pyramid of space that projects into the image of a view."""
    _, camera, T_world_camera = view
    p = transform_points(inverse(T_world_camera), centers)
    met = p[:, 2] > -radius
    for axis, f, c, pixels in ((0, camera.fx, camera.cx, camera.width), (1, camera.fy, camera.cy, camera.height)):
        # Inner normals of the two planes through the outer edges of the first and last pixel.
        for sign, edge in ((1.0, c + 0.5), (-1.0, pixels - 0.5 - c)):
            met &= (sign * f * p[:, axis] + edge * p[:, 2]) / np.hypot(f, edge) >= -radius
    return met


def _observed(
    centers: Array, radius: float, view: DepthView
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which spheres (P,) of a radius [m] a view shows to be empty, looks at, and lacks depth at.

    A view does not look at spheres that are hidden by a surface, or covered by a mask.
    """
    depth, camera, T_world_camera = view
    p = transform_points(inverse(T_world_camera), centers)
    z = p[:, 2]
    empty, looked, lacks_depth = (np.zeros(len(p), np.bool_) for _ in range(3))
    u = np.rint(camera.fx * p[:, 0] / np.maximum(z, 1e-6) + camera.cx)
    v = np.rint(camera.fy * p[:, 1] / np.maximum(z, 1e-6) + camera.cy)
    seen = np.flatnonzero((z > 2 * radius) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
    p, z, u, v = p[seen], z[seen], u[seen], v[seen]
    near = np.maximum(z - radius, 1e-6)
    # The image of a sphere extends beyond f r / (z - r) off the axis, by at most the length of the ray with z = 1.
    stretch = np.sqrt(1.0 + (p[:, 0] / near) ** 2 + (p[:, 1] / near) ** 2)
    reach = np.ceil(max(camera.fx, camera.fy) * radius / near * stretch + 0.5)
    measured = _without_scattered_holes(depth)
    known = measured > 0
    masked = np.isnan(depth)
    holes = (~known & ~masked).astype(np.float32)
    for smaller, width in pairwise((0, *CONSTANTS.radii)):
        chosen = np.flatnonzero((reach > smaller) & (reach <= width))
        if len(chosen):
            row, column = v[chosen].astype(np.int64), u[chosen].astype(np.int64)
            square = np.ones((2 * width + 1,) * 2, np.uint8)
            nearest = cv2.erode(measured, square, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)[row, column]
            farthest = cv2.dilate(measured, square)[row, column]
            share = cv2.blur(holes, square.shape)[row, column]
            empty[seen[chosen]] = nearest > z[chosen] + radius
            hidden = (farthest > 0) & (farthest < z[chosen] - radius)
            looked[seen[chosen]] = ~hidden & ~masked[row, column]
            lacks_depth[seen[chosen]] = looked[seen[chosen]] & (share >= CONSTANTS.suspect_share)
    return empty, looked, lacks_depth


def _without_scattered_holes(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return depth (H, W) [m], 0 where missing, with small groups of missing pixels filled by the least around them."""
    known = np.isfinite(depth) & (depth > 0)
    _, label, stats, _ = cv2.connectedComponentsWithStats((~known).astype(np.uint8), connectivity=8)
    small = stats[:, cv2.CC_STAT_AREA] <= CONSTANTS.scattered
    small[0] = False  # the pixels with depth
    around = np.where(known, depth, np.float32(np.inf)).astype(np.float32)
    for _ in range(CONSTANTS.scattered):
        around = np.where(known, around, cv2.erode(around, np.ones((3, 3), np.uint8)))
    filled = np.where(small[label], around, np.where(known, depth, np.float32(0)))
    return np.asarray(np.where(np.isfinite(filled), filled, 0.0), dtype=np.float32)
