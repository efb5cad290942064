"""Values of a render of surfels in addition to its images, computed on access."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

_PROJECTED = ("means2d", "depths", "normals", "radii", "tiles_per_gauss")
_TILES = ("tile_size", "tile_width", "tile_height", "n_isects", "state_bytes")
_PLAIN = ("width", "height", "n_cameras", "opacities", "visible_ids", "visibility", "gradient_2dgs")


class SurfelMeta(Mapping[str, Any]):
    """A read-only mapping with gsplat's names.

    - means2d (C, N, 2) projected centres [px], depths (C, N) of the centres [m], radii (C, N, 2) int32 [px].
    - normals (C, N, 3) world frame, facing the camera; tiles_per_gauss (C, N). These are zero for surfels out of view.
    - opacities (C, N). visibility (C, N) bool: in view. visible_ids: a list of C tensors of indices.
    - tile_size (width, height) [px], tile_width and tile_height [tiles], n_isects and state_bytes: lists of C.
    - gradient_2dgs (C, N, 2): zeros that the render depends on; the others carry no gradients.
    """

    def __init__(self, states: list[Any], opacities: Tensor, width: int, height: int, shift: Tensor) -> None:
        self._states = states
        self._opacities = opacities
        self._known: dict[str, Any] = {
            "width": width,
            "height": height,
            "n_cameras": len(states),
            "gradient_2dgs": shift,
        }

    def __getitem__(self, key: str) -> Any:
        if key not in self._known:
            if key in _PROJECTED:
                self._describe()
            elif key in _TILES:
                self._describe_tiles()
            elif key == "opacities":
                self._known[key] = self._opacities.expand(len(self._states), -1)
            elif key == "visible_ids":
                self._known[key] = [torch.from_numpy(state.visible()) for state in self._states]
            elif key == "visibility":
                self._known[key] = torch.zeros(len(self._states), len(self._opacities), dtype=torch.bool)
                for row, ids in zip(self._known[key], self["visible_ids"], strict=True):
                    row[ids.long()] = True
            else:
                raise KeyError(key)
        return self._known[key]

    def __iter__(self) -> Iterator[str]:
        return iter((*_PLAIN, *_PROJECTED, *_TILES))

    def __len__(self) -> int:
        return len(_PLAIN) + len(_PROJECTED) + len(_TILES)

    def _describe(self) -> None:
        views = [state.describe() for state in self._states]
        for key in _PROJECTED:
            self._known[key] = torch.stack([torch.from_numpy(view[key]) for view in views])

    def _describe_tiles(self) -> None:
        views = [state.tiles() for state in self._states]
        for key in ("tile_size", "tile_width", "tile_height"):
            self._known[key] = views[0][key]
        for key in ("n_isects", "state_bytes"):
            self._known[key] = [view[key] for view in views]
