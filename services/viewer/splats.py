"""A map's Gaussians for a browser, in cubes of space, so that only changed cubes are sent again."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import covariances
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.rasterize.views import facing_normals

Coloring = Literal["rgb", "depth", "normal", "uncertainty"]
COLORINGS: tuple[Coloring, ...] = get_args(Coloring)


@dataclass(frozen=True)
class SplatConstants:
    """Constants of splats in the viewer.

    Args:
        edge: [m] edge length of a piece.
        max_pieces: largest number of pieces.
        min_variance: [m²] covariances travel as 16-bit floats, whose steps are 6e-8 near 0.
        rounding: relative error of a 16-bit float, at most 2⁻¹¹.
    """

    edge: float = 0.5
    max_pieces: int = 256
    min_variance: float = 1.2e-7
    rounding: float = 5e-4


CONSTANTS = SplatConstants()


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians of one piece.

    Args:
        centers: (N, 3) float32 [m].
        covariances: (N, 3, 3) float32 [m²].
        rgbs: (N, 3) float32, 0..1.
        opacities: (N, 1) float32, 0..1.
    """

    centers: NDArray[np.float32]
    covariances: NDArray[np.float32]
    rgbs: NDArray[np.float32]
    opacities: NDArray[np.float32]

    def select(self, rows: NDArray[np.integer]) -> Splats:
        """Return the Gaussians of these rows (M,)."""
        return Splats(self.centers[rows], self.covariances[rows], self.rgbs[rows], self.opacities[rows])

    @property
    def digest(self) -> bytes:
        """Hash of the values: two pieces that look the same have the same digest."""
        parts = (self.centers, self.covariances, self.rgbs, self.opacities)
        return hashlib.blake2b(b"".join(np.ascontiguousarray(p).tobytes() for p in parts), digest_size=16).digest()


def splats(
    model: GaussianModel,
    coloring: Coloring = "rgb",
    *,
    T_world_camera: Array | None = None,
    scale_of: GaussianModel | None = None,
) -> Splats:
    """Return the Gaussians as a browser draws them.

    The shader projects covariances of 16-bit floats. Those of thin Gaussians, as surfels, may be indefinite, and the
    shader tilts them or leaves them out. The error is at most ``rounding`` times the Frobenius norm. Each Gaussian gets
    this variance at least, so that a round disc is drawn with a thickness of 2.7 % of its size.

    Args:
        model: the map, or a part of it.
        coloring: meaning of the colours. "rgb" shows the map's own; "depth" a camera's depth, red near and blue far.
            "normal" shows the surface's direction, "uncertainty" the position uncertainty, red for the least known.
        T_world_camera: (4, 4) of that camera. If None, the world's origin.
        scale_of: the map whose values give the ends of the colour scale. If None, ``model``.
    """
    with torch.no_grad():
        exact = covariances(model)
        lacking = CONSTANTS.rounding * torch.linalg.matrix_norm(exact) - model.scales.amin(1).square()
        added = lacking.clamp_min(0.0) + CONSTANTS.min_variance
        spread = (exact + added[:, None, None] * torch.eye(3)).numpy()
        opacity = model.opacities.numpy()[:, None]
    rgb = colors(model, coloring, T_world_camera=T_world_camera, scale_of=scale_of)
    return Splats(model.means.numpy(), spread, rgb, opacity)


def pieces(
    model: GaussianModel, coloring: Coloring = "rgb", *, T_world_camera: Array | None = None
) -> dict[tuple[int, int, int], Splats]:
    """Split the Gaussians into cubes of half a metre, or of a doubled edge where there would be too many.

    Args:
        model, coloring, T_world_camera: see :func:`splats`.
    """
    if not len(model):
        return {}
    means = model.means.numpy()
    edge = CONSTANTS.edge
    while len(keys := np.unique(np.floor(means / edge).astype(np.int64), axis=0)) > CONSTANTS.max_pieces:
        edge *= 2
    keys, piece = np.unique(np.floor(means / edge).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(piece.ravel(), kind="stable")
    bounds = np.searchsorted(piece.ravel()[order], np.arange(len(keys) + 1))
    whole = splats(model, coloring, T_world_camera=T_world_camera)
    return {(x, y, z): whole.select(order[bounds[i] : bounds[i + 1]]) for i, (x, y, z) in enumerate(keys.tolist())}


def colors(
    model: GaussianModel,
    coloring: Coloring,
    *,
    T_world_camera: Array | None = None,
    scale_of: GaussianModel | None = None,
) -> NDArray[np.float32]:
    """Return RGB (N, 3) in 0..1; see :func:`splats`.

    Raises:
        InputError: there is no such colouring.
    """
    scale = model if scale_of is None else scale_of
    with torch.no_grad():
        if coloring == "rgb":
            return model.colors.clamp(0, 1).numpy().astype(np.float32)
        if coloring == "uncertainty":
            return _turbo(model.uncertainty.numpy(), scale.uncertainty.numpy())
        T_camera_world = np.eye(4) if T_world_camera is None else inverse(T_world_camera)
        if coloring == "normal":
            normals = facing_normals(model, T_camera_world).numpy()
            return (0.5 + 0.5 * normals * np.array([1, -1, -1])).astype(np.float32)
        if coloring == "depth":
            nearness, ends = (-transform_points(T_camera_world, m.means.numpy())[:, 2] for m in (model, scale))
            return _turbo(nearness, ends)
    raise InputError(f"is {coloring!r}.", field="coloring", hint=f"use {', '.join(COLORINGS)}")


def _turbo(values: NDArray[np.floating], ends: NDArray[np.floating]) -> NDArray[np.float32]:
    """Map values (N,) to RGB (N, 3), blue at the 2nd percentile of ``ends`` (M,), red at the 98th."""
    if not len(values):
        return np.zeros((0, 3), np.float32)
    low, high = np.percentile(ends, [2, 98])
    shares = np.clip((values - low) / max(high - low, 1e-9), 0, 1)
    bgr = cv2.applyColorMap(np.rint(255 * shares).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)
    return (bgr[:, 0, ::-1] / 255).astype(np.float32)
