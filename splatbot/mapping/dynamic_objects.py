"""What moves: pixels that contradict the map in colour and depth, in space that was seen to be free."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.camera import Camera
from splatbot.geometry import inverse, transform_points
from splatbot.mapping.insertion import ModelView
from splatbot.mapping.keyframes import Keyframe

Mask = NDArray[np.bool_]

_DEPTH = 0.06  # nearer than the map by more than this is another thing [share of depth]
_COLOUR = 0.06  # colours that differ by more, on average over the channels, are another thing's [0..1]
_SOLID = 0.8  # where the map covers less it cannot be contradicted
_SPECK = 5  # things narrower than this are noise [px]
_MARGIN = 9  # and what is so near to one is it as well [px]
_WITNESSES = 6  # keyframes that are asked whether a place was free
_CELL = 0.03  # [m] within which a thing that stays is the same
_FORGET = 0.6  # places not seen for longer begin anew [s]


class DynamicObjectFilter:
    """Tells what moves from what is new, and accepts what has stayed.

    Args:
        settle: what appeared in free space and has been at its place for so long belongs to the scene [s].
    """

    def __init__(self, settle: float) -> None:
        self.settle = settle
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
        """Pixels (H, W) bool that show a thing that moves.

        Args:
            view: the map from the same pose, of the same size.
            rgb: (H, W, 3) uint8.
            depth: (H, W) [m], 0 missing.
            keyframes: their depths tell which space was free.
            stamp: time [s]; what was found before is remembered.
        """
        candidates = _disagreeing(view, rgb, depth)
        if not candidates.any():
            return torch.from_numpy(candidates)
        v, u = np.nonzero(candidates)
        points = transform_points(T_world_camera, camera.backproject(depth.numpy())[v, u].astype(np.float64))
        moving = np.zeros_like(candidates)
        moving[v, u] = _was_free(points, keyframes, T_world_camera) & ~self._settled(points, stamp)
        kernel = np.ones((_SPECK, _SPECK), np.uint8)
        things = cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_OPEN, kernel)
        return torch.from_numpy(cv2.dilate(things, np.ones((2 * _MARGIN + 1,) * 2, np.uint8)) > 0)

    def _settled(self, points: NDArray[np.float64], stamp: float) -> Mask:
        """Which points (N, 3) lie in cells that have been taken without a break for ``settle`` seconds."""
        i = np.floor(points / _CELL).astype(np.int64) + (1 << 20)
        cells = (i[:, 0] << 42) | (i[:, 1] << 21) | i[:, 2]
        now, place = np.unique(cells, return_inverse=True)
        alive = stamp - self._seen <= _FORGET
        cells_before, since_before = self._cells[alive], self._since[alive]
        since = np.full(len(now), stamp)
        if len(cells_before):
            at = np.searchsorted(cells_before, now).clip(max=len(cells_before) - 1)
            known = cells_before[at] == now
            since[known] = since_before[at[known]]
        rest = ~np.isin(cells_before, now)
        every = np.concatenate([now, cells_before[rest]])
        order = np.argsort(every)
        self._cells = every[order]
        self._since = np.concatenate([since, since_before[rest]])[order]
        self._seen = np.concatenate([np.full(len(now), stamp), self._seen[alive][rest]])[order]
        return np.asarray((stamp - since >= self.settle)[place])


def _disagreeing(view: ModelView, rgb: Tensor, depth: Tensor) -> Mask:
    """Pixels that are nearer than the map and of another colour, where the map is solid."""
    nearer = (depth > 0) & (depth < (1 - _DEPTH) * view.depth)
    other = (view.rgb - rgb.float() / 255.0).abs().mean(-1) > _COLOUR
    return np.asarray((nearer & other & (view.alpha > _SOLID)).numpy())


def _was_free(points: NDArray[np.float64], keyframes: Sequence[Keyframe], T_world_camera: NDArray[np.float64]) -> Mask:
    """Which points (N, 3) of the world some near keyframe has seen through."""
    near = sorted(keyframes, key=lambda k: float(np.linalg.norm(k.T_world_camera[:3, 3] - T_world_camera[:3, 3])))
    free = np.zeros(len(points), dtype=np.bool_)
    for keyframe in near[:_WITNESSES]:
        camera, local = keyframe.camera, transform_points(inverse(keyframe.T_world_camera), points)
        z = np.maximum(local[:, 2], 1e-6)
        u = np.rint(camera.fx * local[:, 0] / z + camera.cx)
        v = np.rint(camera.fy * local[:, 1] / z + camera.cy)
        inside = (local[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        behind = keyframe.depth.numpy()[np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)]
        free |= inside & (behind * (1 - _DEPTH) > local[:, 2])
    return free
