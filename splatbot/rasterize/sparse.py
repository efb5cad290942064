"""Parts of an image: single pixels or tiles, their front Gaussians, and the Gaussians in view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.cameras import CameraSettings, cameras_of
from splatbot.rasterize.inputs import check_inputs
from splatbot.rasterize.meta import RenderMeta
from splatbot.rasterize.native import native
from splatbot.rasterize.rasterization import rasterization

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
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    pixels: Tensor,
    **options: Any,
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render P pixels of each of C views; bit for bit those of the whole picture; differentiable.

    All Gaussians are projected, as for the whole; blending is done in the 4x4 blocks that hold a requested pixel.

    Args:
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, options: as of ``rasterization``, without
            batch dimensions, ``masks`` and ``tile_size``.
        pixels: (P, 2), or (C, P, 2) for other pixels in each view: integers x, y; may repeat.

    Returns:
        render_colors (C, P, X), render_alphas (C, P, 1), meta.

    Raises:
        InputError: a pixel lies outside the image, or as ``rasterization``.
    """
    at = _pixels_of(pixels, viewmats, width, height)
    masks = _cells(at // _CELL, width, height, _CELL)
    _refuse(options, "masks", "tile_size")
    renders, alphas, meta = rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, masks=masks, tile_size=_CELL, **options
    )
    view = torch.arange(len(at))[:, None]
    x, y = at.unbind(-1)
    return renders[view, y, x], alphas[view, y, x], meta


def rasterize_tiles(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    tiles: Tensor,
    tile_size: int = 16,
    **options: Any,
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render T square tiles of each of C views; bit for bit those of the whole picture; differentiable.

    Args:
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, options: as of ``rasterization``, without
            batch dimensions and ``masks``.
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
    columns, rows = -(-width // tile_size), -(-height // tile_size)
    at = _pixels_of(tiles, viewmats, columns, rows, name="tiles")
    _refuse(options, "masks")
    masks = _cells(at, width, height, tile_size)
    renders, alphas, meta = rasterization(
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmats,
        Ks,
        width,
        height,
        masks=masks,
        tile_size=tile_size,
        **options,
    )
    inside = torch.arange(tile_size)
    x = (at[..., 0, None] * tile_size + inside)[..., None, :]
    y = (at[..., 1, None] * tile_size + inside)[..., :, None]
    seen = ((x < width) & (y < height))[..., None]
    view = torch.arange(len(at))[:, None, None, None]
    x, y = x.clamp_max(width - 1), y.clamp_max(height - 1)
    cut = [torch.where(seen, image[view, y, x], torch.zeros(())) for image in (renders, alphas)]
    return cut[0], cut[1], meta


def contributing_gaussians(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    pixels: Tensor,
    k: int = 8,
    **options: Any,
) -> Contributors:
    """Return the front k Gaussians that contribute to each of P pixels and their weights; without gradients.

    Args:
        means, quats, scales, opacities, viewmats, Ks, width, height, options: as of ``rasterization``, without batch
            dimensions, ``masks``, ``tile_size`` and ``render_mode``.
        pixels: (P, 2), or (C, P, 2) for other pixels in each view: integers x, y; may repeat.
        k: how many to a pixel, at least 1.

    Raises:
        InputError: a pixel lies outside the image, or as ``rasterization``.
    """
    if isinstance(k, bool) or not isinstance(k, int) or k < 1:
        raise InputError(f"is {k!r}.", field="k", hint="give a positive integer")
    at = _pixels_of(pixels, viewmats, width, height)
    masks = _cells(at // _CELL, width, height, _CELL)
    _refuse(options, "masks", "tile_size", "render_mode", "colors")
    with torch.no_grad():
        _, _, meta = rasterization(
            means,
            quats,
            scales,
            opacities,
            None,
            viewmats,
            Ks,
            width,
            height,
            render_mode="D",
            masks=masks,
            tile_size=_CELL,
            **options,
        )
    ids = torch.empty(*at.shape[:2], k, dtype=torch.int64)
    weights = torch.empty(*at.shape[:2], k)
    for c, state in enumerate(meta.states):
        unique, inverse = torch.unique(at[c, :, 1] * width + at[c, :, 0], return_inverse=True)
        found = torch.empty(len(unique), k, dtype=torch.int32)
        shares = torch.empty(len(unique), k)
        state.fronts(unique.numpy(), found.numpy(), shares.numpy())
        ids[c], weights[c] = found[inverse].long(), shares[inverse]
    return Contributors(ids, weights)


def visible_gaussians(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    rasterize_mode: str = "classic",
    camera_model: str = "pinhole",
    covars: Tensor | None = None,
    **camera: Any,
) -> Tensor:
    """Mark the Gaussians (C, N) bool in each view's frustum, hidden behind others or not. Render no image.

    The arguments are those of ``rasterization`` without batch dimensions; ``camera`` holds ``with_ut`` and its options.

    Raises:
        InputError: as ``rasterization``.
    """
    if rasterize_mode not in ("classic", "antialiased"):
        raise InputError(f"{rasterize_mode!r} is not supported.", field="rasterize_mode", hint="classic, antialiased")
    _one_scene(viewmats)
    inputs = check_inputs(
        means, quats, scales, covars, opacities, None, None, viewmats, Ks, None, None, (width, height), _CELL
    ).detached()
    try:
        settings = CameraSettings(camera_model, **camera)
    except TypeError as error:
        raise InputError(f"are not all known ({error}).", field="options", hint="see rasterization") from error
    lenses, poses, _ = cameras_of(settings, inputs.viewmats, float(near_plane))
    seen = torch.zeros(len(poses), len(means), dtype=torch.bool)
    for c in range(len(poses)):
        found = native().visible_gaussians(
            inputs.means,
            inputs.quats,
            inputs.scales,
            inputs.covars,
            inputs.opacities,
            poses[c].double().contiguous(),
            inputs.Ks[c].double().contiguous(),
            width,
            height,
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


def _pixels_of(pixels: Tensor, viewmats: Tensor, width: int, height: int, name: str = "pixels") -> Tensor:
    """Return the checked pixels (C, P, 2) int64."""
    _one_scene(viewmats)
    views = len(viewmats)
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


def _one_scene(viewmats: Tensor) -> None:
    if not isinstance(viewmats, Tensor) or viewmats.ndim != 3:
        raise InputError("is not (C, 4, 4).", field="viewmats", hint="batch dimensions are for rasterization()")


def _cells(at: Tensor, width: int, height: int, size: int) -> Tensor:
    """Mask (C, rows, columns) of the square cells at (C, P, 2)."""
    masks = torch.zeros(len(at), -(-height // size), -(-width // size), dtype=torch.bool)
    masks[torch.arange(len(at))[:, None], at[..., 1], at[..., 0]] = True
    return masks


def _refuse(options: dict[str, Any], *names: str) -> None:
    for name in names:
        if name in options:
            raise InputError("is given by the requested pixels.", field=name, hint="leave it out")
