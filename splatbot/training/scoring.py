"""Scores of a trained map on views that it was not trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.evaluation.image import psnr, ssim
from splatbot.gaussians import GaussianModel
from splatbot.optimize.losses import l1_dssim
from splatbot.results.metrics import without_nan
from splatbot.training.exposures import exposed, fitted_exposure
from splatbot.training.images import ImageCache, Photo
from splatbot.training.options import TrainingOptions
from splatbot.training.poses import CameraPoses
from splatbot.training.rendering import render_photo

_ALIGN_STEPS = 60
_ALIGN_RATES = 3e-3, 1e-4  # [rad] at the first and the last step


@dataclass(frozen=True, eq=False)
class HeldOutScore:
    """Score of one view.

    Args:
        name: of the view.
        psnr_db: over the pixels that may be trained on [dB].
        ssim: over the whole image, 0 to 1, without pixels that may not be trained on; None if it was not wanted.
        images: (2, H, W, 3) uint8, the photograph and the map from its pose; None if they were not wanted.
        corrected_psnr_db: PSNR after the affine colour transform of least squares from the map to the photograph [dB];
            None if it was not wanted.
    """

    name: str
    psnr_db: float
    ssim: float | None = None
    images: NDArray[np.uint8] | None = None
    corrected_psnr_db: float | None = None


def score_held_out(
    model: GaussianModel,
    images: ImageCache,
    options: TrainingOptions,
    extent: float,
    *,
    every: int = 1,
    psnr_only: bool = False,
    shown: int = 0,
    report: Callable[[int], None] = lambda done: None,
) -> list[HeldOutScore]:
    """Render each view of ``images`` and compare it with the photograph; views without a counted pixel are left out.

    With refined poses the map is free to move as a whole. Each view's pose is then aligned to the map first (Lin et al.
    2021, BARF). With compensated exposures the map has the mean exposure of the training views. PSNR is that of the map
    as it is. The colour-corrected PSNR does not depend on the exposure of the view.

    Args:
        model: the map.
        images: the held-out views.
        options: of the training.
        extent: of the scene [m].
        every: score each such view only.
        psnr_only: leave SSIM and the colour-corrected PSNR out.
        shown: number of views, evenly spaced, whose images are kept.
        report: receives the number of views done.
    """
    if not images.views:
        return []
    background, poses = options.shade, CameraPoses([view.T_world_camera for view in images.views], extent)
    kept = set(np.linspace(0, len(images.views) - 1, min(shown, len(images.views))).round().astype(int).tolist())
    scores = []
    for index in range(0, len(images.views), every):
        report(index)
        photo = images.photo(index)
        if photo.trained is not None and not photo.trained.any():
            continue
        if options.refine_poses:
            _align(model, photo, poses, index, background, options)
        with torch.no_grad():
            seen = render_photo(
                model, photo, poses.viewmats[index], background, model.sh_degree, antialiased=options.antialiased
            )
        image, colors, alpha = photo.over(background), seen.image[..., :3], seen.alpha
        counted = torch.ones(image.shape[:2], dtype=torch.bool) if photo.trained is None else photo.trained
        corrected = None
        if not psnr_only:
            transform = fitted_exposure(colors, alpha, background, image, counted)
            corrected = _psnr(exposed(colors, alpha, background, transform), image, counted)
        render = colors.clamp(0, 1).contiguous()
        scores.append(
            HeldOutScore(
                images.views[index].name,
                _psnr(render, image, counted),
                None if psnr_only else _ssim(render, image, photo),
                (255 * torch.stack([image, render])).round().to(torch.uint8).numpy() if index in kept else None,
                corrected,
            )
        )
    return scores


def summary(scores: list[HeldOutScore]) -> dict[str, Any]:
    """Return the means and the single values of scores, for JSON; the means are None without views."""
    values = {
        "psnr_db": [s.psnr_db for s in scores],
        "corrected_psnr_db": [s.corrected_psnr_db or 0.0 for s in scores],
        "ssim": [s.ssim or 0.0 for s in scores],
    }
    means = {name: round(fmean(of), 4) if of else None for name, of in values.items()}
    views = [
        {"name": score.name, **{name: round(of[index], 4) for name, of in values.items()}}
        for index, score in enumerate(scores)
    ]
    found: dict[str, Any] = without_nan({"held_out": len(scores), **means, "views": views})
    return found


def _psnr(render: Tensor, image: Tensor, counted: Tensor) -> float:
    return psnr(render[counted].clamp(0, 1).numpy(), image[counted].numpy())


def _ssim(render: Tensor, image: Tensor, photo: Photo) -> float:
    """Compute the mean SSIM of all windows inside the image, or with a mask of the windows at counted pixels."""
    if photo.trained is None:
        return ssim(render.numpy(), image.numpy())
    return float(1 - l1_dssim(render, image, 1.0, photo.trained))


def _align(
    model: GaussianModel,
    photo: Photo,
    poses: CameraPoses,
    index: int,
    background: Tensor,
    options: TrainingOptions,
) -> None:
    """Move the pose of a view to where the map looks most like the photograph."""
    for step in range(_ALIGN_STEPS):
        viewmat = poses.viewmats[index].clone().requires_grad_()
        render = render_photo(model, photo, viewmat, background, model.sh_degree, antialiased=options.antialiased)
        loss = l1_dssim(render.image[..., :3].contiguous(), photo.over(background), options.dssim_weight, photo.trained)
        (gradient,) = torch.autograd.grad(loss, [viewmat])
        first, last = _ALIGN_RATES
        poses.step(index, gradient, first * (last / first) ** (step / _ALIGN_STEPS))
