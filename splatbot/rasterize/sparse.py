"""Parts of an image: single pixels or tiles, their front Gaussians, and the Gaussians in view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.cameras import CameraSettings, cameras_of
from splatbot.rasterize.inputs import check_inputs
from splatbot.rasterize.meta import RenderMeta
from splatbot.rasterize.native import native
from splatbot.rasterize.rasterization import rasterization
from splatbot.rasterize.scene import Gaussians, Viewpoints

_CELL = 4  # [px] side of the squares that the kernels leave out or render


@dataclass(frozen=True)
class Contributors:
    """The front Gaussians of P pixels in C views, front to back.

    Args:
        ids: (C, P, k) int64; -1 where fewer than k count.
        weights: (C, P, k) float32 blend weights, in 0..1; 0 without a Gaussian.
    """

    ids: Tensor
    weights: Tensor


def rasterize_pixels(
    gaussians: Gaussians, viewpoints: Viewpoints, pixels: Tensor, **options: Any
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render P pixels of each of C views; bit for bit those of the whole picture; differentiable.

    All Gaussians are projected, as for the whole; blending is done in the 4x4 blocks that hold a requested pixel.

    Args:
        gaussians, viewpoints: without batch dimensions.
        options: as of ``rasterization``, without ``masks`` and ``tile_size``.
        pixels: (P, 2), or (C, P, 2) for other pixels in each view: integers x, y; may repeat.

    Returns:
        render_colors (C, P, X), render_alphas (C, P, 1), meta.

    Raises:
        InputError: a pixel lies outside the image, or as ``rasterization``.
    """
    at = _pixels_of(pixels, viewpoints)
    _refuse(options, "masks", "tile_size")
    renders, alphas, meta = _render_cells(gaussians, viewpoints, at // _CELL, _CELL, options)
    view = torch.arange(len(at))[:, None]
    x, y = at.unbind(-1)
    return renders[view, y, x], alphas[view, y, x], meta


def rasterize_tiles(
    gaussians: Gaussians,
    viewpoints: Viewpoints,
    tiles: Tensor,
    tile_size: int = 16,
    **options: Any,
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render T square tiles of each of C views; bit for bit those of the whole picture; differentiable.

    Args:
        gaussians, viewpoints: without batch dimensions.
        options: as of ``rasterization``, without ``masks``.
        tiles: (T, 2), or (C, T, 2): integers column, row; may repeat.
        tile_size: side of a tile [px].

    Returns:
        render_colors (C, T, tile_size, tile_size, X) and render_alphas (C, T, tile_size, tile_size, 1), zero beyond the
        image's edge; meta.

    Raises:
        InputError: a tile lies outside the image, or as ``rasterization``.
    """
    if isinstance(tile_size, bool) or not isinstance(tile_size, int) or tile_size < 1:
        raise InputError(f"is {tile_size!r}.", field="tile_size", hint="give a positive integer [px]")
    width, height = viewpoints.width, viewpoints.height
    grid = replace(viewpoints, width=-(-width // tile_size), height=-(-height // tile_size))
    at = _pixels_of(tiles, grid, name="tiles")
    _refuse(options, "masks")
    renders, alphas, meta = _render_cells(gaussians, viewpoints, at, tile_size, options)
    inside = torch.arange(tile_size)
    x = (at[..., 0, None] * tile_size + inside)[..., None, :]
    y = (at[..., 1, None] * tile_size + inside)[..., :, None]
    seen = ((x < width) & (y < height))[..., None]
    view = torch.arange(len(at))[:, None, None, None]
    x, y = x.clamp_max(width - 1), y.clamp_max(height - 1)
    cut = [torch.where(seen, image[view, y, x], torch.zeros(())) for image in (renders, alphas)]
    return cut[0], cut[1], meta


def contributing_gaussians(
    gaussians: Gaussians,
    viewpoints: Viewpoints,
    pixels: Tensor,
    k: int = 8,
    **options: Any,
) -> Contributors:
    """Return the front k Gaussians that contribute to each of P pixels and their weights; without gradients.

    Args:
        gaussians, viewpoints: without batch dimensions; colours have no effect.
        options: as of ``rasterization``, without ``masks``, ``tile_size`` and ``render_mode``.
        pixels: (P, 2), or (C, P, 2) for other pixels in each view: integers x, y; may repeat.
        k: how many to a pixel, at least 1.

    Raises:
        InputError: a pixel lies outside the image, or as ``rasterization``.
    """
    if isinstance(k, bool) or not isinstance(k, int) or k < 1:
        raise InputError(f"is {k!r}.", field="k", hint="give a positive integer")
    at = _pixels_of(pixels, viewpoints)
    _refuse(options, "masks", "tile_size", "render_mode")
    with torch.no_grad():
        _, _, meta = _render_cells(gaussians, viewpoints, at // _CELL, _CELL, {**options, "render_mode": "D"})
    ids = torch.empty(*at.shape[:2], k, dtype=torch.int64)
    weights = torch.empty(*at.shape[:2], k)
    for c, state in enumerate(meta.states):
        unique, inverse = torch.unique(at[c, :, 1] * viewpoints.width + at[c, :, 0], return_inverse=True)
        found = torch.empty(len(unique), k, dtype=torch.int32)
        shares = torch.empty(len(unique), k)
        state.fronts(unique.numpy(), found.numpy(), shares.numpy())
        ids[c], weights[c] = found[inverse].long(), shares[inverse]
    return Contributors(ids, weights)


def visible_gaussians(
    gaussians: Gaussians,
    viewpoints: Viewpoints,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    rasterize_mode: str = "classic",
    camera_model: str = "pinhole",
    **camera: Any,
) -> Tensor:
    """Mark the Gaussians (C, N) bool in each view's frustum, hidden behind others or not. Render no image.

    The options are those of ``rasterization``; ``camera`` holds ``with_ut`` and its options. The tensors have no batch
    dimensions.

    Raises:
        InputError: as ``rasterization``.
    """
    if rasterize_mode not in ("classic", "antialiased"):
        raise InputError(f"{rasterize_mode!r} is not supported.", field="rasterize_mode", hint="classic, antialiased")
    _one_scene(viewpoints)
    inputs = check_inputs(gaussians, viewpoints, "D").detached()
    try:
        settings = CameraSettings(camera_model, **camera)
    except TypeError as error:
        raise InputError(f"are not all known ({error}).", field="options", hint="see rasterization") from error
    lenses, poses, _ = cameras_of(settings, inputs.viewmats, float(near_plane))
    seen = torch.zeros(len(poses), inputs.layout.n_gaussians, dtype=torch.bool)
    for c in range(len(poses)):
        found = native().visible_gaussians(
            inputs.means,
            inputs.quats,
            inputs.scales,
            inputs.covars,
            inputs.opacities,
            poses[c].double().contiguous(),
            inputs.Ks[c].double().contiguous(),
            viewpoints.width,
            viewpoints.height,
            float(near_plane),
            float(far_plane),
            float(radius_clip),
            float(eps2d),
            rasterize_mode == "antialiased",
            None if lenses is None else lenses[c],
        )
        if isinstance(found, tuple):
            raise InputError(f"row {found[1]} is not finite.", field=found[0], hint="find where it comes from")
        seen[c, torch.from_numpy(found)] = True
    return seen


def _pixels_of(pixels: Tensor, viewpoints: Viewpoints, name: str = "pixels") -> Tensor:
    """Return the checked pixels (C, P, 2) int64."""
    _one_scene(viewpoints)
    views, width, height = len(viewpoints.viewmats), viewpoints.width, viewpoints.height
    if not isinstance(pixels, Tensor) or pixels.is_floating_point() or pixels.is_complex():
        raise InputError("holds no integers.", field=name, hint="give an integer tensor (P, 2)")
    if pixels.shape[-1:] != (2,) or pixels.ndim not in (2, 3) or (pixels.ndim == 3 and len(pixels) != views):
        raise InputError(f"is {tuple(pixels.shape)}.", field=name, hint=f"give (P, 2) or ({views}, P, 2)")
    at = pixels.long().expand(views, -1, -1)
    outside = ((at < 0) | (at >= torch.tensor([width, height]))).any(-1)
    if bool(outside.any()):
        _, row = outside.nonzero()[0].tolist()
        raise InputError(f"row {row} lies outside {width} x {height}.", field=name, hint="give x, y from 0 on")
    return at


def _one_scene(viewpoints: Viewpoints) -> None:
    viewmats = viewpoints.viewmats
    if not isinstance(viewmats, Tensor) or viewmats.ndim != 3:
        raise InputError("is not (C, 4, 4).", field="viewmats", hint="batch dimensions are for rasterization()")


def _render_cells(
    gaussians: Gaussians, viewpoints: Viewpoints, at: Tensor, size: int, options: dict[str, Any]
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render the square cells at (C, P, 2) alone."""
    masks = torch.zeros(len(at), -(-viewpoints.height // size), -(-viewpoints.width // size), dtype=torch.bool)
    masks[torch.arange(len(at))[:, None], at[..., 1], at[..., 0]] = True
    return rasterization(**vars(gaussians), **vars(viewpoints), masks=masks, tile_size=size, **options)


def _refuse(options: dict[str, Any], *names: str) -> None:
    for name in names:
        if name in options:
            raise InputError("is given by the requested pixels.", field=name, hint="leave it out")
