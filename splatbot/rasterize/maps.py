"""One view of a map, by the model of its Gaussians: 3D Gaussian splatting, or 2D if the map holds surfels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.surfels import holds_surfels
from splatbot.rasterize.meta import RenderMeta
from splatbot.rasterize.rasterization import rasterization
from splatbot.rasterize.surfel_meta import SurfelMeta
from splatbot.rasterize.surfels import rasterization_2dgs


@dataclass(frozen=True, eq=False)
class SurfelImages:
    """Images that only surfels have.

    Args:
        normals: (H, W, 3) of the surfels, facing the camera, world frame, blended.
        depth_normals: (H, W, 3) of the rendered depth, world frame; None without depth.
        distortion: (H, W, 1) Σᵢⱼ wᵢ wⱼ |mᵢ - mⱼ| [m]; None if it was not requested.
        median: (H, W, 1) depth at which half of the light is left [m]; 0 for none.
    """

    normals: Tensor
    depth_normals: Tensor | None
    distortion: Tensor | None
    median: Tensor


@dataclass(frozen=True, eq=False)
class MapRender:
    """A view of a map.

    Args:
        image: (H, W, X) colours or features, and depth [m] as the last channel if the mode has it.
        alpha: (H, W, 1) in 0..1.
        meta: of the rasterizer.
        surfels: further images of surfels; None for a map of 3D Gaussians.
    """

    image: Tensor
    alpha: Tensor
    meta: RenderMeta | SurfelMeta
    surfels: SurfelImages | None

    def center_gradients(self, *, absolute: bool = False) -> Tensor:
        """Return the gradients (N, 2) of the projected centres [px⁻¹] after the backward pass, 0 out of view.

        Args:
            absolute: the sums over pixels of absolute values, which surfels do not have.
        """
        if isinstance(self.meta, SurfelMeta):
            return torch.as_tensor(self.meta["gradient_2dgs"].grad[0])
        centers = self.meta["means2d"]
        found = torch.zeros(self.meta["visibility"].shape[-1], 2)
        return found.index_copy_(0, self.meta["gaussian_ids"], centers.absgrad if absolute else centers.grad)


def render_map(
    model: GaussianModel,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    features: Tensor | None = None,
    degree: int | None = None,
    background: Tensor | None = None,
    render_mode: Literal["RGB", "ED", "RGB+ED"] = "RGB",
    surfels: bool | None = None,
    antialiased: bool = False,
    absgrad: bool = False,
    distortion: bool = False,
) -> MapRender:
    """Render one view of a map; differentiable.

    Args:
        model: the map.
        viewmat: (4, 4) T_camera_world.
        K: (3, 3) intrinsics [px], pixel centres at +0.5.
        width, height: of the image [px].
        features: (N, D) in place of the colours; None for the harmonics.
        degree: of the harmonics in use; None for all.
        background: (D,) seen where the map is transparent; None for black.
        render_mode: of :func:`splatbot.rasterize.rasterization`. Depth is that of the planes of Gaussians, or of
            the discs.
        surfels: whether the Gaussians are surfels; None for :func:`holds_surfels`.
        antialiased: whether opacities compensate the low-pass filter; not for surfels.
        absgrad: whether the absolute gradients of the projected centres are needed; not for surfels.
        distortion: whether surfels render their distortion.

    Raises:
        InputError: a value does not fit, is not finite, or is not possible for surfels.
    """
    arguments: dict[str, Any] = {
        "means": model.means,
        "quats": model.quats,
        "scales": model.scales,
        "opacities": model.opacities,
        "colors": model.sh if features is None else features.contiguous(),
        "sh_degree": None if features is not None else model.sh_degree if degree is None else degree,
        "viewmats": viewmat[None],
        "Ks": K[None],
        "width": width,
        "height": height,
        "backgrounds": None if background is None else background[None],
        "render_mode": render_mode,
        "absgrad": absgrad,
    }
    if not (holds_surfels(model) if surfels is None else surfels):
        renders, alphas, meta = rasterization(
            **arguments,
            depth_mode="center" if render_mode == "RGB" else "plane",  # centres of slanted surfaces lie in front of it
            rasterize_mode="antialiased" if antialiased else "classic",
        )
        return MapRender(renders[0], alphas[0], meta, None)
    if antialiased:
        raise InputError("is not possible for surfels.", field="antialiased", hint="leave it out")
    renders, alphas, normals, depth_normals, distort, median, of_surfels = rasterization_2dgs(
        **arguments, distloss=distortion
    )
    images = SurfelImages(normals[0], _first(depth_normals), _first(distort), median[0])
    return MapRender(renders[0], alphas[0], of_surfels, images)


def _first(images: Tensor | None) -> Tensor | None:
    return None if images is None else images[0]
