"""Cost of a render: milliseconds by stage and the pairs that it evaluated."""

from __future__ import annotations

from dataclasses import dataclass

from splatbot.rasterize.meta import RenderMeta


@dataclass(frozen=True)
class RasterWork:
    """Work of one view. Milliseconds of the last forward and the last backward pass (0 before one).

    Args:
        evaluated_pairs: (Gaussian, pixel) pairs of a blend pass: the pixels of the 4x4 blocks that each Gaussian
            reaches and that were open when it came.
    """

    project_ms: float
    order_ms: float
    list_tiles_ms: float
    blend_ms: float
    blend_backward_ms: float
    project_backward_ms: float
    evaluated_pairs: int


def raster_work(meta: RenderMeta) -> list[RasterWork]:
    """Return the work of each view of a render; the stages of ``backward()`` appear after it."""
    return [RasterWork(**state.work()) for state in meta._states]
