"""Cost of each option of a render: time with it minus time without it [ms]."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from splatbot.bench.raster.scenes import SplatScene
from splatbot.bench.results import Results
from splatbot.bench.timing import measure
from splatbot.errors import InputError
from splatbot.geometry import quat_to_rotation
from splatbot.rasterize import rasterization

Arguments = dict[str, Any]


@dataclass(frozen=True)
class RasterOption:
    """An option; ``change`` returns the arguments of a call with it from those without."""

    name: str
    change: Callable[[Arguments], Arguments]


def all_effects() -> list[RasterOption]:
    """Return all options in the order of the report."""
    return [
        RasterOption("depth (RGB+ED)", lambda a: a | {"render_mode": "RGB+ED"}),
        RasterOption("plane depth", lambda a: a | {"render_mode": "RGB+ED", "depth_mode": "plane"}),
        RasterOption("background", lambda a: a | {"backgrounds": torch.ones(1, 3)}),
        *(RasterOption(f"harmonics of degree {d}", partial(with_harmonics, degree=d)) for d in range(5)),
        RasterOption("antialiased", lambda a: a | {"rasterize_mode": "antialiased"}),
        RasterOption("covariances given", _covariances),
        RasterOption("absolute gradients", lambda a: a | {"absgrad": True}),
        RasterOption("packed", lambda a: a | {"packed": True}),
        RasterOption("unscented transform", lambda a: a | {"with_ut": True}),
        RasterOption(
            "lens distortion",
            lambda a: a | {"with_ut": True, "radial_coeffs": torch.tensor([[0.02, -0.01, 0.0, 0.0, 0.0, 0.0]])},
        ),
        RasterOption("orthographic camera", lambda a: a | {"camera_model": "ortho"}),
        RasterOption("fisheye camera", lambda a: a | {"camera_model": "fisheye"}),
        RasterOption("normals", lambda a: a | {"return_normals": True}),
        RasterOption("pose gradient", lambda a: a | {"viewmats": a["viewmats"].clone().requires_grad_()}),
        RasterOption("intrinsics' gradient", lambda a: a | {"Ks": a["Ks"].clone().requires_grad_()}),
    ]


def run_effects(results: Results, scene: SplatScene, size: tuple[int, int], *, runs: int, budget_s: float) -> None:
    """Add a row per option and pass; an option that this build refuses gets the reason as its note."""
    plain = plain_arguments(scene, size)
    case = f"effect on {scene.name} {size[0]}x{size[1]}"
    for effect in all_effects():
        changed = effect.change(plain)
        try:
            _forward(changed)
            _forward_backward(changed)
        except (InputError, RuntimeError) as error:
            note = str(error).splitlines()[0]
            results.add(f"{case}: {effect.name}", "forward, on minus off", None, "ms", note=note)
            continue
        for metric, run in (("forward", _forward), ("forward+backward", _forward_backward)):
            # Off and on by turns, so that a busy moment of the machine strikes both.
            off, on = [], []
            for _ in range(3):
                off.append(measure(partial(run, plain), runs=runs, budget_s=budget_s / 6).least_ms)
                on.append(measure(partial(run, changed), runs=runs, budget_s=budget_s / 6).least_ms)
            results.add(f"{case}: {effect.name}", f"{metric}, off", min(off), "ms")
            results.add(f"{case}: {effect.name}", f"{metric}, on minus off", min(on) - min(off), "ms")


def plain_arguments(scene: SplatScene, size: tuple[int, int]) -> Arguments:
    """Return arguments of ``rasterization`` without options, with gradients of all five tensors."""
    leaves = {name: t.detach().clone().requires_grad_() for name, t in scene.gaussians.items()}
    return leaves | scene.view(*size)


def with_harmonics(arguments: Mapping[str, Any], degree: int) -> Arguments:
    """Replace colours by coefficients (N, K, 3) of spherical harmonics with the same mean colours."""
    colors = arguments["colors"].detach()
    generator = torch.Generator().manual_seed(2)
    coefficients = 0.1 * torch.randn(len(colors), (degree + 1) ** 2, 3, generator=generator)
    coefficients[:, 0] = (colors - 0.5) / 0.28209479177387814
    return dict(arguments) | {"colors": coefficients.requires_grad_(), "sh_degree": degree}


def _covariances(arguments: Mapping[str, Any]) -> Arguments:
    R = torch.from_numpy(quat_to_rotation(arguments["quats"].detach().numpy())).float()
    half = R * arguments["scales"].detach()[:, None]
    return dict(arguments) | {"covars": (half @ half.mT).requires_grad_()}


def _forward(arguments: Arguments) -> Tensor:
    with torch.no_grad():
        return rasterization(**arguments)[0]


def _forward_backward(arguments: Arguments) -> object:
    image, _, meta = rasterization(**arguments)
    if arguments.get("absgrad"):
        meta["means2d"].retain_grad()
    leaves = [v for v in arguments.values() if isinstance(v, Tensor) and v.requires_grad]
    return torch.autograd.grad(image, leaves, torch.ones_like(image), allow_unused=True)
