"""Values of a render in addition to its images, computed on access."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping
from typing import Any

import torch
from torch import Tensor

from splatbot.rasterize.centers import Centers
from splatbot.rasterize.inputs import Layout
from splatbot.rasterize.intersections import isect_offset_encode, isect_tiles
from splatbot.rasterize.options import RasterOptions

_PROJECTED = ("depths", "conics", "radii", "opacities")
_PAIRS = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")
_IDS = ("batch_ids", "camera_ids", "gaussian_ids")
_NATIVE = ("n_isects", "state_bytes")
_FINDERS = (
    {"means2d": "_find_projected", "visibility": "_find_visibility", "visible_ids": "_find_visibility"}
    | dict.fromkeys(_PROJECTED, "_find_projected")
    | dict.fromkeys(_PAIRS, "_find_pairs")
    | dict.fromkeys(_IDS, "_find_ids")
    | dict.fromkeys(_NATIVE, "_find_native")
    | {"contributions": "_find_contributions"}
)


class RenderMeta(MutableMapping[str, Any]):
    """A mapping with gsplat's names; shapes below are those of ``packed=False`` (in brackets: packed).

    In packed layout, values per Gaussian and view have P rows: those in view, ordered by view and index.

    - means2d (..., C, N, 2) [P, 2] px: belongs to the graph, so that ``retain_grad()`` works; with ``absgrad``, it has
      ``.absgrad`` after backward. Read it before backward if its gradient is needed.
    - depths (..., C, N) [P] m; conics (..., C, N, 3) [P, 3] px⁻²: inverse 2D covariance, upper triangle. Not
      differentiable.
    - radii (..., C, N, 2) [P, 2] px int32, opacities (..., C, N) [P] as blended. Not differentiable.
    - batch_ids, camera_ids, gaussian_ids: [P] int64; None if not packed.
    - tile_size px, tile_width and tile_height: the grid of gsplat's tiles; tiles_per_gauss (..., C, N) [P], isect_ids,
      flatten_ids, isect_offsets (..., C, tile_height, tile_width): see :mod:`splatbot.rasterize.intersections`.
    - visibility (..., C, N) bool: in view. ``contributions`` (..., C, N) int32: number of pixels to which the Gaussian
      contributes. ``visible_ids``: a list of index tensors, one per view. Never packed.
    - normals (..., C, H, W, 3), with ``return_normals``: in the graph. median_ids (..., C, H, W) int32, with median
      depth: its Gaussian, or -1.
    - n_isects, state_bytes: lists over the views, of the kernels' own (Gaussian, tile) pairs and memory.
    - width, height, n_batches, n_cameras.

    Out of view, rows are zero (opacities: only if antialiased).
    """

    def __init__(
        self,
        states: tuple[Any, ...],
        layout: Layout,
        options: RasterOptions,
        opacities: Tensor,
        centers: Centers,
        means2d: Tensor,
    ) -> None:
        self._states = states
        self._layout = layout
        self._options = options
        self._opacities = opacities
        self._centers = centers
        self._means2d: Tensor | None = means2d
        self._known: dict[str, Any] = self._plain()
        self._to_find = dict(_FINDERS)

    @property
    def states(self) -> tuple[Any, ...]:
        """State that the native pass of each view left."""
        return self._states

    def __getitem__(self, key: str) -> Any:
        if key not in self._known:
            getattr(self, self._to_find[key])()
        if key == "means2d":
            self._centers.exposed = True
        return self._known[key]

    def __setitem__(self, key: str, value: Any) -> None:
        self._known[key] = value

    def __delitem__(self, key: str) -> None:
        found = self._known.pop(key, self)
        if self._to_find.pop(key, None) is None and found is self:
            raise KeyError(key)

    def __contains__(self, key: object) -> bool:
        return key in self._known or key in self._to_find

    def __iter__(self) -> Iterator[str]:
        return iter(list(self._known) + [key for key in self._to_find if key not in self._known])

    def __len__(self) -> int:
        return len(set(self._known) | set(self._to_find))

    def _plain(self) -> dict[str, Any]:
        layout, options = self._layout, self._options
        return {
            "width": options.width,
            "height": options.height,
            "tile_size": options.tile_size,
            "tile_width": -(-options.width // options.tile_size),
            "tile_height": -(-options.height // options.tile_size),
            "n_batches": layout.n_batches,
            "n_cameras": layout.n_cameras,
        }

    def _stack(self, rows: list[Any], like: Tensor) -> Tensor:
        """Stack the rows (N, ...) of all views; ``like`` gives their shape if there is no view."""
        return torch.cat([like, *map(torch.from_numpy, rows)])

    def _arranged(self, rows: Tensor) -> Tensor:
        """Arrange rows (views x N, ...) in the layout of the meta."""
        ids = self._centers.ids
        return self._dense(rows) if ids is None else rows[ids]

    def _dense(self, rows: Tensor) -> Tensor:
        return rows.reshape(*self._layout.views, self._layout.n_gaussians, *rows.shape[1:])

    def _find_ids(self) -> None:
        ids, n = self._centers.ids, max(self._layout.n_gaussians, 1)
        if ids is None:
            self._known.update(dict.fromkeys(_IDS))
            return
        view = ids // n
        self._known["batch_ids"] = view // max(self._layout.n_cameras, 1)
        self._known["camera_ids"] = view % max(self._layout.n_cameras, 1)
        self._known["gaussian_ids"] = ids % n

    def _find_projected(self) -> None:
        views = [state.describe() for state in self._states]
        pairs, integers = torch.zeros(0, 2), torch.zeros(0, 2, dtype=torch.int32)
        empty = {"means2d": pairs, "radii": integers, "conics": torch.zeros(0, 3)}
        found = {}
        for key in ("means2d", *_PROJECTED):
            rows = self._stack([view[key] for view in views], empty.get(key, torch.zeros(0)))
            found[key] = self._arranged(rows)
        if not self._options.antialiased:
            found["opacities"] = self._plain_opacities()
        if self._means2d is not None:
            self._means2d.detach().copy_(found["means2d"])
            found["means2d"], self._means2d = self._means2d, None
        self._known = {**found, **self._known}

    def _plain_opacities(self) -> Tensor:
        layout = self._layout
        every = self._opacities.reshape(layout.n_batches, 1, -1).expand(-1, layout.n_cameras, -1)
        ids = self._centers.ids
        return every.reshape(*layout.views, -1) if ids is None else every.reshape(-1)[ids]

    def _find_pairs(self) -> None:
        layout, (columns, rows) = self._layout, (self["tile_width"], self["tile_height"])
        per_view = (layout.n_views, layout.n_gaussians)
        self._find_projected_once()
        means2d = self._known["means2d"].detach()
        radii, depths = self._known["radii"], self._known["depths"]
        view = None
        if self._centers.ids is None:
            means2d, radii = means2d.reshape(*per_view, 2), radii.reshape(*per_view, 2)
            depths = depths.reshape(per_view)
        else:
            view = self._centers.ids // max(layout.n_gaussians, 1)
        count, ids, flat = isect_tiles(means2d, radii, depths, self._options.tile_size, columns, rows, view)
        offsets = isect_offset_encode(ids, layout.n_views, columns, rows)
        self._known["tiles_per_gauss"] = count if view is not None else count.reshape(*layout.views, -1)
        self._known["isect_ids"], self._known["flatten_ids"] = ids, flat
        self._known["isect_offsets"] = offsets.reshape(*layout.views, rows, columns)

    def _find_projected_once(self) -> None:
        if self._means2d is not None:
            self._find_projected()

    def _find_native(self) -> None:
        views = [state.tiles() for state in self._states]
        for key in _NATIVE:
            self._known[key] = [view[key] for view in views]

    def _find_visibility(self) -> None:
        ids = [torch.from_numpy(state.visible()) for state in self._states]
        seen = torch.zeros(self._layout.n_views, self._layout.n_gaussians, dtype=torch.bool)
        for row, visible in zip(seen, ids, strict=True):
            row[visible] = True
        self._known["visible_ids"] = ids
        self._known["visibility"] = seen.reshape(*self._layout.views, -1)

    def _find_contributions(self) -> None:
        rows = self._stack([state.contributions() for state in self._states], torch.zeros(0, dtype=torch.int32))
        self._known["contributions"] = self._dense(rows)
