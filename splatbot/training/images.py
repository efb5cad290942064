"""Training images in memory: decoded once, with half, quarter and eighth sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.training.datasets import TrainingView
from splatbot.training.datasets.images import resample, scaled, scaled_depth, scaled_mask

_LEAST_SIDE = 96  # [px] smaller images are not reduced further


@dataclass(frozen=True, eq=False)
class Photo:
    """One image at one size.

    Args:
        camera: of this size.
        rgb: (H, W, 3) float32 in 0..1, straight.
        alpha: (H, W) float32 in 0..1, or None if the image is opaque.
        trained: (H, W) bool, False where the image must not be trained on; or None for all.
        depth: (H, W) [m], 0 without measurement; or None.
    """

    camera: Camera
    rgb: Tensor
    alpha: Tensor | None
    trained: Tensor | None
    depth: Tensor | None

    def over(self, background: Tensor) -> Tensor:
        """Return the image (H, W, 3) in front of a background colour (3,)."""
        if self.alpha is None:
            return self.rgb
        return self.rgb * self.alpha[..., None] + background * (1 - self.alpha[..., None])


class ImageCache:
    """Reads each view once; keeps uint8 colours, and depth and masks, of each size in use."""

    def __init__(self, views: Sequence[TrainingView]) -> None:
        self.views = tuple(views)
        self._kept: dict[tuple[int, int], tuple[NDArray[np.uint8], NDArray[np.bool_] | None, Tensor | None]] = {}

    def photo(self, index: int, reduce: int = 1) -> Photo:
        """Return view ``index`` at 1/``reduce`` of its size.

        Raises:
            SplatbotError: an image cannot be read.
        """
        reduce = self._fitting(index, reduce)
        if (index, reduce) not in self._kept:
            self._kept[index, reduce] = self._reduced(index, reduce)
        image, left_out, depth = self._kept[index, reduce]
        values = torch.from_numpy(image)
        alpha = values[..., 3].float() / 255 if image.shape[2] == 4 else None
        trained = None if left_out is None else torch.from_numpy(~left_out)
        return Photo(self.camera(index, reduce), values[..., :3].float() / 255, alpha, trained, depth)

    def camera(self, index: int, reduce: int = 1) -> Camera:
        """Return the camera of view ``index`` at 1/``reduce`` of its size, without reading the image."""
        camera, reduce = self.views[index].camera, self._fitting(index, reduce)
        return camera if reduce == 1 else camera.resized(camera.width // reduce, camera.height // reduce)

    def with_views(self, views: Sequence[TrainingView]) -> ImageCache:
        """Return the same images, not read again, as those of ``views`` that differ in intrinsics alone."""
        other = ImageCache(views)
        other._kept = self._kept
        return other

    def _fitting(self, index: int, reduce: int) -> int:
        """Return the largest reduction up to ``reduce`` that keeps an image large enough."""
        camera = self.views[index].camera
        while reduce > 1 and min(camera.width, camera.height) // reduce < _LEAST_SIDE:
            reduce //= 2
        return reduce

    def _reduced(self, index: int, reduce: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None, Tensor | None]:
        view = self.views[index]
        if reduce == 1:
            depth = None if view.read_depth is None else torch.from_numpy(view.read_depth())
            return view.read(), None if view.read_mask is None else view.read_mask(), depth
        self.photo(index)
        image, left_out, depth = self._kept[index, 1]
        size = image.shape[1] // reduce, image.shape[0] // reduce
        small = resample(image, lambda pixels: scaled(pixels, size))
        mask = None if left_out is None else scaled_mask(left_out, size)
        return small, mask, None if depth is None else torch.from_numpy(scaled_depth(depth.numpy(), size))


def pixels(views: Sequence[TrainingView]) -> int:
    """Return the number of pixels of views in all."""
    return sum(view.camera.width * view.camera.height for view in views)


def check_memory(folder: Path, *held: Sequence[TrainingView]) -> None:
    """Check that images fit into the free memory: 4 bytes a pixel, 4 more of depth, and smaller sizes.

    Args:
        folder: of the dataset.
        held: views of each process of this machine that reads them; over a run, a process holds all of its views.

    Raises:
        InputError: they do not.
    """
    each = 8 if any(view.read_depth is not None for views in held for view in views) else 4
    needed = 4 / 3 * each * sum(map(pixels, held))
    free = _free_memory()
    if free is not None and needed > 0.7 * free:
        least = math.ceil(math.sqrt(needed / (0.7 * free)))
        hint = f"reduce the images: --scale {2 ** math.ceil(math.log2(least))}, times a scale already given"
        several = f" in {len(held)} processes" if len(held) > 1 else ""
        why = f"needs {needed / 1e9:.1f} GB for its images{several}, and {free / 1e9:.1f} GB are free."
        hint += "; or use fewer --processes" if several else ""
        raise InputError(why, file=folder, field="--scale", hint=hint)


def _free_memory() -> float | None:
    """Return the free memory [bytes], or None where the system does not report it."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((1024.0 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), None)
