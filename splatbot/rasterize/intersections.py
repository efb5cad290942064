"""Which square tiles each projected Gaussian's box meets, in gsplat's encoding; for programs that read such lists.

The kernels themselves cull exactly, in larger tiles, and do not use this.
"""

from __future__ import annotations

import torch
from torch import Tensor


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    image_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """List the pairs of Gaussians and tiles, sorted by image, tile and depth; pairs of one depth by index.

    Args:
        means2d: (I, N, 2) [px]; packed, (P, 2).
        radii: (I, N, 2) int32 [px], 0 for Gaussians out of view; packed, (P, 2).
        depths: (I, N) positive [m]; packed, (P,).
        tile_size: side of a tile [px].
        tile_width: of the grid [tiles].
        tile_height: of the grid [tiles].
        image_ids: packed: (P,) the image of each row; else None.

    Returns:
        ``tiles_per_gauss`` (I, N) or (P,) int32. ``isect_ids`` (M,) int64: image, tile and float bits of the depth,
        from the highest bits on. ``flatten_ids`` (M,) int32: rows of the flattened inputs.
    """
    shape = depths.shape
    center, radius = means2d.reshape(-1, 2).double() / tile_size, radii.reshape(-1, 2).double() / tile_size
    limit = torch.tensor([tile_width, tile_height])
    first = (center - radius).floor().long().clamp_min(0).minimum(limit)
    last = (center + radius).ceil().long().clamp_min(0).minimum(limit)
    size = (last - first).clamp_min(0) * (radii.reshape(-1, 2) > 0).all(-1, keepdim=True)
    count = size.prod(-1)
    row = torch.repeat_interleave(torch.arange(len(count)), count)
    within = torch.arange(len(row)) - (count.cumsum(0) - count)[row]
    x = first[row, 0] + within % size[row, 0]
    y = first[row, 1] + within // size[row, 0]
    image = row // max(shape[-1], 1) if image_ids is None else image_ids[row].long()
    bits = tile_bits(tile_width, tile_height)
    depth = depths.reshape(-1).float().contiguous().view(torch.int32).long()[row]
    keys = (image << (32 + bits)) | ((y * tile_width + x) << 32) | depth
    ids, order = keys.sort(stable=True)
    return count.reshape(shape).int(), ids, row[order].int()


def tile_bits(tile_width: int, tile_height: int) -> int:
    """Return the number of bits of an id that hold the tile."""
    return (tile_width * tile_height).bit_length()


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Return each tile's first pair (I, tile_height, tile_width) int32 among the ids of :func:`isect_tiles`."""
    bits, tiles = tile_bits(tile_width, tile_height), tile_width * tile_height
    image, tile = isect_ids >> (32 + bits), (isect_ids >> 32) & ((1 << bits) - 1)
    begin = torch.searchsorted((image * tiles + tile).contiguous(), torch.arange(n_images * tiles))
    return begin.reshape(n_images, tile_height, tile_width).int()
