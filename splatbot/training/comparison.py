"""Two maps from the same poses: images, depth, and scores against each other and against recorded images."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.evaluation.geometry import depth_error
from splatbot.evaluation.image import psnr, ssim
from splatbot.gaussians import GaussianModel
from splatbot.rasterize.views import render_rgbd
from splatbot.spacing import evenly_spaced
from splatbot.training.images import ImageCache
from splatbot.training.map_views import MapViews, around

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class ComparisonConstants:
    """Constants of comparisons.

    Args:
        min_alpha: least opacity of a pixel that a map covers.
        least_overlap: share of the pixels of either map that both cover; with less, the maps do not overlap.
        most_depth_difference: [share of depth] largest median difference of maps in one frame.
    """

    min_alpha: float = 0.5
    least_overlap: float = 0.1
    most_depth_difference: float = 0.1


CONSTANTS = ComparisonConstants()


@dataclass(frozen=True, eq=False)
class SeenMap:
    """A map from one pose.

    Args:
        rgb: (H, W, 3).
        depth: (H, W) [m], 0 where the map does not cover the pixel.
    """

    rgb: Image
    depth: NDArray[np.float32]

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Return the pixels (H, W) that the map covers."""
        return np.asarray(self.depth > 0)


@dataclass(frozen=True, eq=False)
class ComparedView:
    """Two maps from one pose, and the recorded image.

    Args:
        name: of the view.
        a, b: the maps.
        recorded: (H, W, 3); None if the view is not recorded.
        scores: figures by name. ``psnr_db`` and ``ssim`` are those of B against A. ``psnr_a_db``, ``ssim_a``,
            ``psnr_b_db`` and ``ssim_b`` are against the recorded image, if there is one. ``depth_error_a`` and
            ``depth_error_b`` are medians [m] over measured depth that the map covers, ``measured_a`` and ``measured_b``
            the covered shares of measured pixels. ``covered_a``, ``covered_b`` and ``overlap`` are shares of pixels.
            ``depth_difference`` is the median share of the depth, where both maps have depth.
    """

    name: str
    a: SeenMap
    b: SeenMap
    recorded: Image | None
    scores: Mapping[str, float | None]


def compare_recorded(
    a: GaussianModel, b: GaussianModel, views: MapViews, views_of_b: MapViews | None, count: int
) -> Iterator[ComparedView]:
    """Compare maps at views of the recording of A; held-out views if there are any.

    Against the recorded image, B is rendered from the pose that its own run estimated, if it saw the same recording.

    Args:
        a, b: the maps.
        views: of A, or of B if only B has some.
        views_of_b: views with poses of B; None if they are those of A.
        count: largest number of views.
    """
    shade = views.options.shade
    own = {view.name: view.T_world_camera for view in views_of_b.data.views} if views_of_b is not None else {}
    for view in evenly_spaced(views.held_out or views.mapped, count):
        photo = ImageCache([view]).photo(0)
        recorded = (255.0 * photo.over(shade)).round().numpy().astype(np.uint8)
        counted = None if photo.trained is None else photo.trained.numpy()
        camera, T, background = view.camera, view.T_world_camera, shade.numpy()
        seen_a, seen_b = (_seen(model, camera, T, background) for model in (a, b))
        posed_b = _seen(b, camera, own[view.name], background) if view.name in own else seen_b
        scores = _scores(seen_a, seen_b)
        for name, seen in (("a", seen_a), ("b", posed_b)):
            scores[f"psnr_{name}_db"], scores[f"ssim_{name}"] = _against(seen.rgb, recorded, counted)
            if photo.depth is not None:
                error = depth_error(seen.depth, photo.depth)
                scores[f"depth_error_{name}"], scores[f"measured_{name}"] = error.median, error.coverage
        yield ComparedView(view.name, seen_a, seen_b, recorded, scores)


def compare_around(a: GaussianModel, b: GaussianModel, count: int) -> Iterator[ComparedView]:
    """Compare maps without a recording, from virtual views around A."""
    for number, (camera, T) in enumerate(around(a, count)):
        seen_a, seen_b = (_seen(model, camera, T, np.zeros(3, np.float32)) for model in (a, b))
        yield ComparedView(f"virtual {number}", seen_a, seen_b, None, _scores(seen_a, seen_b))


def summary(views: Iterable[ComparedView]) -> dict[str, float | None]:
    """Return the means of the scores of views; None where no view has a value."""
    found: dict[str, list[float]] = {}
    for view in views:
        for name, value in view.scores.items():
            found.setdefault(name, [])
            if value is not None and np.isfinite(value):
                found[name].append(value)
    return {name: fmean(values) if values else None for name, values in found.items()}


def doubts(means: Mapping[str, Any]) -> list[str]:
    """Return why two maps cannot be compared, from the means of their scores; empty if they can."""
    overlap, difference = means["overlap"], means["depth_difference"]
    if overlap is None or overlap < CONSTANTS.least_overlap:
        share = 100.0 * (overlap or 0.0)
        return [f"The maps do not overlap: both cover only {share:.0f} % of the pixels that either covers."]
    if difference is not None and difference > CONSTANTS.most_depth_difference:
        share = 100.0 * difference
        return [f"The maps are probably not in one frame: their depths differ by {share:.0f} % in the median."]
    return []


def _seen(model: GaussianModel, camera: Camera, T_world_camera: Array, background: NDArray[np.float32]) -> SeenMap:
    rgb, alpha, depth = render_rgbd(model, camera, T_world_camera)
    rgb = np.clip(rgb + (1.0 - alpha[..., None]) * background, 0.0, 1.0)
    covered = alpha >= CONSTANTS.min_alpha
    return SeenMap(np.rint(255.0 * rgb).astype(np.uint8), np.where(covered, depth, np.float32(0)))


def _scores(a: SeenMap, b: SeenMap) -> dict[str, float | None]:
    both, either = a.covered & b.covered, a.covered | b.covered
    difference = np.abs(b.depth[both] - a.depth[both]) / a.depth[both]
    return {
        "psnr_db": psnr(b.rgb, a.rgb),
        "ssim": ssim(b.rgb, a.rgb),
        "covered_a": float(a.covered.mean()),
        "covered_b": float(b.covered.mean()),
        "overlap": float(both.sum() / either.sum()) if either.any() else None,
        "depth_difference": float(np.median(difference)) if both.any() else None,
    }


def _against(rgb: Image, recorded: Image, counted: NDArray[np.bool_] | None) -> tuple[float | None, float | None]:
    """Return PSNR [dB] over the counted pixels, and SSIM of the image with the others equal."""
    if counted is None:
        return psnr(rgb, recorded), ssim(rgb, recorded)
    if not counted.any():
        return None, None
    return psnr(rgb[counted], recorded[counted]), ssim(np.where(counted[..., None], rgb, recorded), recorded)
