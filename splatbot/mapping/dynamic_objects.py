"""Dynamic objects: pixels that contradict the map in color and depth, in space that keyframes observed to be free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.camera import Camera
from splatbot.geometry import inverse, transform_points
from splatbot.mapping.insertion import ModelView
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.pixels import pixels_of

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class DynamicObjectConstants:
    """Constants of the dynamic object filter.

    Args:
        depth_share: [share of depth] a pixel nearer than the map by more shows another object.
        color_difference: [0..1] a mean difference of the channels by more shows another object.
        opaque_alpha: only where the map covers more can a pixel contradict it.
        least_width: [px] narrower objects are noise.
        margin: [px] pixels this near a dynamic object count as part of it.
        checked_keyframes: number of nearest keyframes that may have observed free space.
        cell_size: [m] an object that stays within cells of this size is static.
        forget_after_s: [s] a cell that is not observed for longer starts again.
    """

    depth_share: float = 0.06
    color_difference: float = 0.06
    opaque_alpha: float = 0.8
    least_width: int = 5
    margin: int = 9
    checked_keyframes: int = 6
    cell_size: float = 0.03
    forget_after_s: float = 0.6


CONSTANTS = DynamicObjectConstants()


class DynamicObjectFilter:
    """Separates dynamic objects from new static ones, and accepts an object once it has stayed long enough.

    Args:
        timeout_s: an object that appeared in free space becomes static once it has stayed for this long [s].
    """

    def __init__(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        # Occupied cells, sorted by key: key, time of the first and of the latest observation [s].
        self._cells = np.zeros(0, np.int64)
        self._since = np.zeros(0)
        self._seen = np.zeros(0)

    def find(
        self,
        view: ModelView,
        rgb: Tensor,
        depth: Tensor,
        camera: Camera,
        T_world_camera: NDArray[np.float64],
        keyframes: Sequence[Keyframe],
        stamp: float,
    ) -> Tensor:
        """Find the pixels (H, W) bool that show a dynamic object, and remember where it is.

        Args:
            view: the map rendered from the same pose, at the same size.
            rgb: (H, W, 3) uint8.
            depth: (H, W) [m], 0 missing.
            T_world_camera: (4, 4).
            keyframes: their depth images show which space was free.
            stamp: time [s].
        """
        candidates = _contradictions(view, rgb, depth)
        if not candidates.any():
            return torch.from_numpy(candidates)
        v, u = np.nonzero(candidates)
        points = transform_points(T_world_camera, camera.backproject(depth.numpy())[v, u].astype(np.float64))
        dynamic = np.zeros_like(candidates)
        dynamic[v, u] = _was_free(points, keyframes, T_world_camera) & ~self._is_static(points, stamp)
        kernel = np.ones((CONSTANTS.least_width, CONSTANTS.least_width), np.uint8)
        objects = cv2.morphologyEx(dynamic.astype(np.uint8), cv2.MORPH_OPEN, kernel)
        return torch.from_numpy(cv2.dilate(objects, np.ones((2 * CONSTANTS.margin + 1,) * 2, np.uint8)) > 0)

    def _is_static(self, points: NDArray[np.float64], stamp: float) -> Mask:
        """Return which points (N, 3) lie in cells that were occupied without a break for ``timeout_s`` seconds."""
        i = np.floor(points / CONSTANTS.cell_size).astype(np.int64) + (1 << 20)
        keys = (i[:, 0] << 42) | (i[:, 1] << 21) | i[:, 2]
        now, index = np.unique(keys, return_inverse=True)
        alive = stamp - self._seen <= CONSTANTS.forget_after_s
        cells_before, since_before = self._cells[alive], self._since[alive]
        since = np.full(len(now), stamp)
        if len(cells_before):
            at = np.searchsorted(cells_before, now).clip(max=len(cells_before) - 1)
            known = cells_before[at] == now
            since[known] = since_before[at[known]]
        rest = ~np.isin(cells_before, now)
        cells = np.concatenate([now, cells_before[rest]])
        order = np.argsort(cells)
        self._cells = cells[order]
        self._since = np.concatenate([since, since_before[rest]])[order]
        self._seen = np.concatenate([np.full(len(now), stamp), self._seen[alive][rest]])[order]
        return np.asarray((stamp - since >= self.timeout_s)[index])


def _contradictions(view: ModelView, rgb: Tensor, depth: Tensor) -> Mask:
    """Return pixels nearer than the map and of another color, where the map is opaque."""
    nearer = (depth > 0) & (depth < (1 - CONSTANTS.depth_share) * view.depth)
    recolored = (view.rgb - rgb.float() / 255.0).abs().mean(-1) > CONSTANTS.color_difference
    return np.asarray((nearer & recolored & (view.alpha > CONSTANTS.opaque_alpha)).numpy())


def _was_free(points: NDArray[np.float64], keyframes: Sequence[Keyframe], T_world_camera: NDArray[np.float64]) -> Mask:
    """Return which points (N, 3) of the world lie in front of the depth of one of the nearest keyframes."""
    near = sorted(keyframes, key=lambda k: float(np.linalg.norm(k.T_world_camera[:3, 3] - T_world_camera[:3, 3])))
    free = np.zeros(len(points), dtype=np.bool_)
    for keyframe in near[: CONSTANTS.checked_keyframes]:
        camera, local = keyframe.camera, transform_points(inverse(keyframe.T_world_camera), points)
        u, v, inside = (values.numpy() for values in pixels_of(camera, torch.from_numpy(local)))
        measured = keyframe.depth.numpy()[v.astype(int), u.astype(int)]
        free |= inside & (measured * (1 - CONSTANTS.depth_share) > local[:, 2])
    return free
