"""Renders of photographs' views, for the loss and for scores."""

from __future__ import annotations

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.rasterize.maps import MapRender, render_map
from splatbot.training.images import Photo


def render_photo(
    model: GaussianModel,
    photo: Photo,
    viewmat: Tensor,
    background: Tensor,
    degree: int,
    *,
    K: Tensor | None = None,
    depth: bool = False,
    surfels: bool | None = None,
    antialiased: bool = False,
    absgrad: bool = False,
    distortion: bool = False,
) -> MapRender:
    """Render the view of a photograph: colours (H, W, 3), or (H, W, 4) with depth.

    Args:
        model: the map.
        photo: gives the camera; if it has depth, the render has depth too.
        viewmat: (4, 4) T_camera_world.
        background: (3,) seen where the map is transparent.
        degree: of the harmonics in use.
        K: (3, 3) intrinsics with pixel centres at +0.5; None for those of the photograph.
        depth: whether depth is needed without that of the photograph.
        surfels, antialiased, absgrad, distortion: see :func:`splatbot.rasterize.maps.render_map`.
    """
    return render_map(
        model,
        viewmat,
        torch.from_numpy(photo.camera.K_corner) if K is None else K,
        photo.camera.width,
        photo.camera.height,
        degree=degree,
        background=background,
        render_mode="RGB+ED" if depth or photo.depth is not None else "RGB",
        surfels=surfels,
        antialiased=antialiased,
        absgrad=absgrad,
        distortion=distortion,
    )
