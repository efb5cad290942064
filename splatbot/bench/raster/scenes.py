"""The scenes that the rasterizer is measured on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.rasterize.views import default_view

MAP_WIDTH, MAP_HEIGHT = 320, 240  # [px] grid that the surface map is back-projected from
BOX_DISTANCE = 2.5  # [m] from the camera to the centre of the random scenes


@dataclass(frozen=True)
class SplatScene:
    """Gaussians and a camera.

    Args:
        name: of the scene, in results.
        gaussians: the tensors by the argument names of ``rasterization``: means (N, 3) [m, world], quats (N, 4) wxyz,
            scales (N, 3) [m], opacities (N,), colors (N, 3), in this order.
        viewmat: (4, 4) world to camera.
        fov: horizontal field of view [rad].
    """

    name: str
    gaussians: dict[str, Tensor]
    viewmat: Tensor
    fov: float

    def __len__(self) -> int:
        return len(self.gaussians["means"])

    def intrinsics(self, width: int, height: int) -> Tensor:
        """Return intrinsics (1, 3, 3) [px] with the principal point at the centre."""
        focal = 0.5 * width / math.tan(0.5 * self.fov)
        return torch.tensor([[[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]]])

    def view(self, width: int, height: int) -> dict[str, Any]:
        """Return the camera arguments of ``rasterization``."""
        return {"viewmats": self.viewmat[None], "Ks": self.intrinsics(width, height), "width": width, "height": height}

    def select(self, index: Tensor, name: str) -> SplatScene:
        """Select some of the Gaussians."""
        return replace(self, name=name, gaussians={key: t[index] for key, t in self.gaussians.items()})


def surface_map(width: int = MAP_WIDTH, height: int = MAP_HEIGHT, *, sigma_px: float = 1.0) -> SplatScene:
    """Build a table with two boxes, one round Gaussian of opacity 0.7 per pixel (76,800 by default).

    Args:
        width, height: of the grid of pixels.
        sigma_px: standard deviation of a Gaussian in pixels of that grid.
    """
    generator = torch.Generator().manual_seed(0)
    focal = 0.9 * width
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = (u - 0.5 * width) / focal, (v - 0.5 * height) / focal
    z = 1.6 / (1.0 + 1.2 * y)
    for (cu, cv), (du, dv), share in (((0.4, 0.5), (0.12, 0.15), 0.85), ((0.7, 0.6), (0.08, 0.2), 0.8)):
        box = ((u / width - cu).abs() < du) & ((v / height - cv).abs() < dv)
        z = torch.where(box, share * z, z)
    n = width * height
    return SplatScene(
        name="surface",
        gaussians={
            "means": torch.stack([x * z, y * z, z], -1).reshape(n, 3).contiguous(),
            "quats": torch.randn(n, 4, generator=generator),
            "scales": (sigma_px * z / focal).reshape(n, 1).expand(n, 3).contiguous(),
            "opacities": torch.full((n,), 0.7),
            "colors": torch.rand(n, 3, generator=generator),
        },
        viewmat=torch.eye(4),
        fov=2.0 * math.atan(0.5 * width / focal),
    )


def random_box(n: int, *, shrink: float = 1.0) -> SplatScene:
    """Sample Gaussians uniformly in [-1, 1]³, scales 1e-4..0.02, opacity 0..1; camera at z = -2.5, 60° field of view.

    Args:
        n: number of Gaussians.
        shrink: factor of the scales; sqrt(1e5 / n) keeps the blends per pixel those of 1e5.
    """
    g = torch.Generator().manual_seed(n)
    viewmat = torch.eye(4)
    viewmat[2, 3] = BOX_DISTANCE
    return SplatScene(
        name=f"random {_thousands(n)}",
        gaussians={
            "means": 2.0 * torch.rand(n, 3, generator=g) - 1.0,
            "quats": torch.randn(n, 4, generator=g),
            "scales": shrink * (1e-4 + (0.02 - 1e-4) * torch.rand(n, 3, generator=g)),
            "opacities": torch.rand(n, generator=g),
            "colors": torch.rand(n, 3, generator=g),
        },
        viewmat=viewmat,
        fov=math.radians(60.0),
    )


def from_file(path: Path) -> SplatScene:
    """Load a map or splat file with its default view.

    Raises:
        InputError: the file cannot be read.
    """
    model = GaussianModel.load(path)
    camera, T_world_camera = default_view(model)
    return SplatScene(
        name=path.stem,
        gaussians={
            "means": model.means,
            "quats": model.quats,
            "scales": model.log_scales.exp(),
            "opacities": model.opacities.contiguous(),
            "colors": model.colors.contiguous(),
        },
        viewmat=torch.from_numpy(inverse(T_world_camera).astype(np.float32)),
        fov=2.0 * math.atan(0.5 * camera.width / camera.fx),
    )


def _thousands(n: int) -> str:
    return f"{n // 1_000_000}M" if n % 1_000_000 == 0 else f"{n // 1000}k" if n % 1000 == 0 else str(n)
