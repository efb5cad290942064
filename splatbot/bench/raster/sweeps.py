"""Error over time for each setting of the rasterizer, and growth of the time with Gaussians and pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from splatbot.bench.raster.options import plain_arguments, with_harmonics
from splatbot.bench.raster.scenes import SplatScene, random_box, surface_map
from splatbot.bench.results import Results
from splatbot.bench.timing import isa, measure
from splatbot.errors import InputError
from splatbot.rasterize import Gaussians, Viewpoints, rasterization, rasterization_reference
from splatbot.rasterize.native import native
from splatbot.rasterize.work import RasterWork, raster_work

SWEEP = "sweep"
GROWTH = "growth"


@dataclass(frozen=True)
class Setting:
    """A value of a knob with the arguments of ``rasterization``; the ``exact`` one is the reference of the others."""

    knob: str
    value: float
    arguments: dict[str, Any]
    exact: bool = False
    default: bool = False


def run_sweeps(
    results: Results, scene: SplatScene, size: tuple[int, int], *, runs: int, budget_s: float, quick: bool
) -> None:
    """Measure time [ms] and error of each setting of each knob, then of each instruction set against float64."""
    exact: dict[str, Tensor] = {}
    for setting in _settings(scene, size):
        case = f"{SWEEP} {setting.knob} on {scene.name}: {setting.value:g}{' (default)' if setting.default else ''}"
        try:
            image = _render(setting.arguments)
        except (InputError, TypeError) as error:
            results.add(case, "forward", None, "ms", note=str(error).splitlines()[0])
            continue
        if setting.exact:
            exact[setting.knob] = image
        results.add_time(case, "forward", measure(partial(_render, setting.arguments), runs=runs, budget_s=budget_s))
        if setting.knob in exact:
            _add_errors(results, case, image, exact[setting.knob])
    _sweep_instruction_sets(results, runs=runs, budget_s=budget_s, quick=quick)


def _settings(scene: SplatScene, size: tuple[int, int]) -> Iterator[Setting]:
    """Yield the settings of each knob, the most exact one first."""
    plain = _detached(scene, size)
    for clip in (0.0, 0.5, 1.0, 2.0, 4.0):
        yield Setting("radius_clip", clip, plain | {"radius_clip": clip}, exact=clip == 0.0, default=clip == 0.0)
    weight = scene.gaussians["opacities"] * scene.gaussians["scales"].amax(-1) ** 2
    order = torch.argsort(weight, descending=True)
    for percent in (100, 80, 60, 40, 20):
        index = order[: max(1, len(order) * percent // 100)].sort().values
        fewer = scene.select(index, scene.name)
        yield Setting(
            "percent_of_gaussians", percent, _detached(fewer, size), exact=percent == 100, default=percent == 100
        )
    for limit in (0.0, 1e-6, 1e-4, 1e-3, 1e-2):
        arguments = plain | {"transmittance_min": limit}
        yield Setting("transmittance_min", limit, arguments, exact=limit == 0.0, default=limit == 1e-4)
    top = with_harmonics(plain, 4)
    for degree in (4, 3, 2, 1, 0):
        cut = top | {"colors": top["colors"].detach()[:, : (degree + 1) ** 2].contiguous(), "sh_degree": degree}
        yield Setting("sh_degree", degree, cut, exact=degree == 4)
    for unscented in (1, 0):
        arguments = plain | {"with_ut": True} if unscented else plain
        yield Setting("unscented_transform", unscented, arguments, exact=unscented == 1, default=unscented == 0)


def _sweep_instruction_sets(results: Results, *, runs: int, budget_s: float, quick: bool) -> None:
    """Measure the instruction sets; they differ in rounding and in the exponential.

    AVX-512 uses a table and degree 2, the others degree 5.
    """
    arguments, exact, safe = _reference_case(quick=quick)
    large = _detached(*_speed_case(quick))
    for name in native().available_isas():
        with isa(name):
            case = f"{SWEEP} instruction set: {name}"
            image = _render(arguments)
            results.add_time(case, "forward", measure(partial(_render, large), runs=runs, budget_s=budget_s))
            _add_errors(results, case, torch.where(safe, image.double(), exact), exact)


def error_against_reference() -> float:
    """Return the largest error of a small image against float64, with the kernels in use."""
    arguments, exact, safe = _reference_case(quick=False)
    return float(torch.where(safe, (_render(arguments).double() - exact).abs(), 0.0).max())


def _reference_case(*, quick: bool) -> tuple[dict[str, Any], Tensor, Tensor]:
    """Return arguments, their image in float64, and a mask of the pixels that rounding cannot flip."""
    scene = random_box(200 if quick else 2000, shrink=3.0)
    size = (24, 16) if quick else (96, 64)
    means, quats, scales, opacities, colors = (t.detach().double() for t in scene.gaussians.values())
    exact, _, meta = rasterization_reference(
        Gaussians(means, quats, scales, opacities, colors),
        Viewpoints(scene.viewmat[None].double(), scene.intrinsics(*size).double(), *size),
    )
    return _detached(scene, size), exact, (meta.margins > 1e-4)[..., None].reshape(*exact.shape[:-1], 1)


def _detached(scene: SplatScene, size: tuple[int, int]) -> dict[str, Any]:
    return {k: v.detach() if isinstance(v, Tensor) else v for k, v in plain_arguments(scene, size).items()}


def _speed_case(quick: bool) -> tuple[SplatScene, tuple[int, int]]:
    return (surface_map(24, 16), (24, 16)) if quick else (surface_map(), (320, 240))


def _add_errors(results: Results, case: str, image: Tensor, exact: Tensor) -> None:
    error = (image.double() - exact.double()).abs()
    mse = float((error**2).mean())
    results.add(case, "largest error", float(error.max()), "")
    results.add(
        case, "PSNR", -10.0 * math.log10(mse) if mse > 0 else None, "dB", note=None if mse > 0 else "no difference"
    )


def run_growth(results: Results, *, runs: int, budget_s: float, quick: bool) -> None:
    """Measure the time over the number of Gaussians, at equal blends per pixel, and over the number of pixels."""
    counts = (200, 600, 2000) if quick else (10_000, 30_000, 100_000, 300_000, 1_000_000)
    size = (64, 48) if quick else (640, 480)
    for n in counts:
        scene = random_box(n, shrink=math.sqrt(1e5 / n) if not quick else 3.0 * math.sqrt(2000 / n))
        _grow(results, f"{GROWTH} gaussians", n, scene, size, runs=runs, budget_s=budget_s)
    for width, height in (
        ((32, 24), (64, 48)) if quick else ((320, 240), (640, 480), (1280, 720), (1920, 1080), (3840, 2160))
    ):
        scene = random_box(500 if quick else 100_000)
        _grow(results, f"{GROWTH} pixels", width * height, scene, (width, height), runs=runs, budget_s=budget_s)
    for kind, metric in (("gaussians", _ONE_GAUSSIAN), ("pixels", _ONE_PAIR)):
        costs = [row.value for row in results.select(f"{GROWTH} {kind}: ") if row.metric == metric and row.value]
        worst = max(after / before for i, before in enumerate(costs) for after in costs[i:])
        results.add(f"{GROWTH} {kind}", f"{metric}: growth against linear, at worst", worst, "x")
        results.add(f"{GROWTH} {kind}", f"{metric}: largest over smallest", max(costs) / min(costs), "x")


_PER_GAUSSIAN = "stages over Gaussians"
_PER_PIXEL = "stages over pixels"
_ONE_GAUSSIAN = "one Gaussian"
_ONE_PAIR = "one evaluated pair"


def _grow(
    results: Results, kind: str, n: int, scene: SplatScene, size: tuple[int, int], *, runs: int, budget_s: float
) -> None:
    arguments = plain_arguments(scene, size)
    leaves = [v for v in arguments.values() if isinstance(v, Tensor) and v.requires_grad]
    works: list[RasterWork] = []

    def step() -> None:
        image, _, meta = rasterization(**arguments)
        torch.autograd.grad(image, leaves, torch.ones_like(image))
        works.append(raster_work(meta)[0])

    case = f"{kind}: {n}"
    results.add_time(case, "forward+backward", measure(step, runs=runs, budget_s=budget_s))
    per_gaussian = min(w.project_ms + w.order_ms + w.list_tiles_ms + w.project_backward_ms for w in works)
    results.add(case, _PER_GAUSSIAN, per_gaussian, "ms")
    per_pixel = min(w.blend_ms + w.blend_backward_ms for w in works)
    pairs = works[0].evaluated_pairs
    results.add(case, _PER_PIXEL, per_pixel, "ms")
    results.add(case, "pairs per pixel", pairs / (size[0] * size[1]), "")
    # Blends per pixel are not exactly constant, because no footprint is smaller than the blur of eps2d.
    results.add(case, _ONE_GAUSSIAN, 1e6 * per_gaussian / len(scene), "ns")
    results.add(case, _ONE_PAIR, 1e6 * per_pixel / pairs if pairs else None, "ns")


def _render(arguments: dict[str, Any]) -> Tensor:
    with torch.no_grad():
        return rasterization(**arguments)[0]
