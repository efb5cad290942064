"""Scores of a trained map on views that it was not trained on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.evaluation.image import psnr, ssim
from splatbot.gaussians import GaussianModel
from splatbot.optimize.losses import l1_dssim
from splatbot.training.images import ImageCache, Photo
from splatbot.training.options import TrainingOptions
from splatbot.training.poses import CameraPoses
from splatbot.training.trainer import render_photo

_ALIGN_STEPS = 60
_ALIGN_RATES = 3e-3, 1e-4  # [rad] at the first and the last step

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class HeldOutScore:
    """Score of one view.

    Args:
        name: of the view.
        psnr_db: [dB].
        ssim: 0 to 1.
        image: (H, W, 3) the photograph, in 0..1.
        render: (H, W, 3) the map from its pose.
    """

    name: str
    psnr_db: float
    ssim: float
    image: Image
    render: Image


def score_held_out(
    model: GaussianModel, images: ImageCache, options: TrainingOptions, extent: float
) -> list[HeldOutScore]:
    """Render each view of ``images`` and compare it with the photograph, over all pixels that may be trained on.

    With refined poses the map is free to move as a whole. Each view's pose is then aligned to the map first (Lin et al.
    2021, BARF).

    Args:
        model: the map.
        images: the held-out views.
        options: of the training.
        extent: of the scene [m].
    """
    background = torch.full((3,), 1.0 if options.background == "white" else 0.0)
    poses = CameraPoses([view.T_world_camera for view in images.views], extent)
    scores = []
    for index, view in enumerate(images.views):
        photo = images.photo(index)
        if options.refine_poses:
            _align(model, photo, poses, index, background, options)
        with torch.no_grad():
            render, _, _ = render_photo(
                model,
                photo,
                poses.viewmats[index],
                background,
                model.sh_degree,
                antialiased=options.antialiased,
            )
        image, shown = photo.over(background).numpy(), render[..., :3].clamp(0, 1).numpy()
        if photo.trained is not None:
            shown = np.where(photo.trained.numpy()[..., None], shown, image)
        scores.append(HeldOutScore(view.name, psnr(shown, image), ssim(shown, image), image, shown))
    return scores


def summary(scores: list[HeldOutScore]) -> dict[str, Any]:
    """Return the means and the single values of scores, for JSON; the means are None without views."""
    values: Mapping[str, list[float]] = {
        "psnr_db": [score.psnr_db for score in scores],
        "ssim": [score.ssim for score in scores],
    }
    means = {name: round(fmean(of), 4) if of else None for name, of in values.items()}
    views = [{"name": s.name, "psnr_db": round(s.psnr_db, 4), "ssim": round(s.ssim, 4)} for s in scores]
    return {"held_out": len(scores), **means, "views": views}


def _align(
    model: GaussianModel,
    photo: Photo,
    poses: CameraPoses,
    index: int,
    background: torch.Tensor,
    options: TrainingOptions,
) -> None:
    """Move the pose of a view to where the map looks most like the photograph."""
    for step in range(_ALIGN_STEPS):
        viewmat = poses.viewmats[index].clone().requires_grad_()
        render, _, _ = render_photo(model, photo, viewmat, background, model.sh_degree, antialiased=options.antialiased)
        loss = l1_dssim(render[..., :3].contiguous(), photo.over(background), options.dssim_weight, photo.trained)
        (gradient,) = torch.autograd.grad(loss, [viewmat])
        first, last = _ALIGN_RATES
        poses.step(index, gradient, first * (last / first) ** (step / _ALIGN_STEPS))
