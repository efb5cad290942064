"""Measurements of `splatbot bench raster`: speed of the rasterizer, compared with peers and with the machine's peak."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.machine import describe_machine, raise_peaks
from splatbot.bench.raster import RasterSettings
from splatbot.bench.raster.options import run_effects
from splatbot.bench.raster.peers import all_peers
from splatbot.bench.raster.scenes import SplatScene, from_file, random_box, surface_map
from splatbot.bench.raster.sweeps import run_growth, run_sweeps
from splatbot.bench.raster.variants import run_variants
from splatbot.bench.results import Results
from splatbot.bench.timing import Timing, measure, peak_memory, threads
from splatbot.optimize.losses import l1_dssim
from splatbot.rasterize import rasterization
from splatbot.rasterize.meta import RenderMeta
from splatbot.rasterize.work import RasterWork, raster_work

# Floating-point operations of a (Gaussian, pixel) pair with RGB and depth, counted in the algorithm.
FORWARD_FLOP, BACKWARD_FLOP = 34, 62


def scenes_of(settings: RasterSettings) -> list[SplatScene]:
    """Return the surface map, random boxes, and the scene of ``settings.splat``."""
    if settings.quick:
        built_in = [surface_map(24, 16), random_box(500)]
    else:
        built_in = [surface_map(), *(random_box(n) for n in (10_000, 100_000, 500_000))]
    return built_in + ([from_file(settings.splat)] if settings.splat is not None else [])


def run_raster(settings: RasterSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Measure all scenes, options, sweeps and peers of the settings."""
    report_progress("measuring the machine")
    results = Results(describe_machine(settings.threads, peak_ms=settings.peak_ms))
    scenes, size = scenes_of(settings), settings.sizes[0]
    runs, budget_s = settings.runs, settings.budget_s
    for count in settings.threads:
        for scene in scenes:
            for each in settings.sizes:
                case = case_name(scene, each, count)
                report_progress(case)
                with threads(count):
                    run_case(settings, results, scene, each, case)
                raise_peaks(results.machine, count, peak_ms=5.0 if settings.quick else 50.0)
        add_shares(results, count)
        settings.save(results)
    parts: list[tuple[str, Callable[[], None]]] = [
        ("loss", partial(run_loss, settings, results)),
        ("what options cost", partial(run_effects, results, scenes[0], size, runs=runs, budget_s=budget_s)),
        (
            "accuracy against time",
            partial(run_sweeps, results, scenes[1], size, runs=runs, budget_s=budget_s, quick=settings.quick),
        ),
        ("growth", partial(run_growth, results, runs=max(2, runs // 5), budget_s=budget_s, quick=settings.quick)),
    ]
    for name, part in parts:
        report_progress(name)
        with threads(max(settings.threads)):
            part()
        settings.save(results)
    if settings.peers:
        with threads(1):  # as the peers
            run_peers(settings, results, report_progress)
    if settings.variants:
        run_variants(results, threads=max(settings.threads), report_progress=report_progress)
    return results


def case_name(scene: SplatScene, size: tuple[int, int], count: int) -> str:
    """Return the name of a case, as in "surface 320x240, 2 threads"."""
    return f"{scene.name} {size[0]}x{size[1]}, {count} thread{'s' if count > 1 else ''}"


def run_case(settings: RasterSettings, results: Results, scene: SplatScene, size: tuple[int, int], case: str) -> None:
    """Forward, forward and backward, pose only, memory, pairs and the stages' times."""
    passes = Passes(scene, size)
    for metric, function in (
        ("forward", passes.forward),
        ("forward+backward", passes.forward_backward),
        ("forward+pose backward", passes.pose_backward),
    ):
        results.add_time(case, metric, measure(function, runs=settings.runs, budget_s=settings.budget_s))
    memory = peak_memory(passes.forward_backward)
    results.add(case, "peak memory", None if memory is None else memory / 2**20, "MiB")
    results.add(case, "state memory", passes.state_bytes() / 2**20, "MiB")
    work = passes.best_work(max(2, settings.runs // 3))
    results.add(case, "evaluated pairs", float(work.evaluated_pairs), "pairs")
    for stage in ("project", "order", "list_tiles", "blend", "blend_backward", "project_backward"):
        results.add(case, f"stage {stage}", getattr(work, f"{stage}_ms"), "ms")


def add_shares(results: Results, count: int) -> None:
    """Add the shares of the peak that the blend stages reach, for the cases with ``count`` threads."""
    peak = results.machine["fma_peak_gflops"][results.machine["isa"]][str(count)]
    ending = f", {count} thread{'s' if count > 1 else ''}"
    pairs = {r.case: r.value for r in results.rows if r.metric == "evaluated pairs" and r.case.endswith(ending)}
    for case, evaluated in pairs.items():
        for name, flop, stage in (
            ("forward", FORWARD_FLOP, "stage blend"),
            ("backward", BACKWARD_FLOP, "stage blend_backward"),
        ):
            ms = results.find(case, stage)
            share = 1e-6 * flop * evaluated / ms / peak if ms and evaluated else None
            results.add(case, f"blend {name}, share of FMA peak", None if share is None else 100.0 * share, "%")


class Passes:
    """The passes over one scene at one size, as users call them: RGB and expected depth, through autograd."""

    def __init__(self, scene: SplatScene, size: tuple[int, int], render_mode: str = "RGB+ED") -> None:
        view = scene.view(*size) | {"render_mode": render_mode}
        self._pose = view["viewmats"].clone().requires_grad_()
        self._plain: dict[str, Any] = scene.gaussians | view
        self._leaves = {name: t.detach().clone().requires_grad_() for name, t in scene.gaussians.items()}
        scales = scene.gaussians["scales"]
        self.round = bool((scales == scales[:, :1]).all())
        channels = 4 if "D" in render_mode else 3
        generator = torch.Generator().manual_seed(1)
        self.upstream = torch.randn(1, size[1], size[0], channels, generator=generator)

    def forward(self) -> Tensor:
        """Render the image without gradients."""
        with torch.no_grad():
            return rasterization(**self._plain)[0]

    def forward_backward(self) -> RenderMeta:
        """Compute gradients with respect to all five tensors."""
        image, _, meta = rasterization(**(self._plain | self._leaves))
        torch.autograd.grad(image, tuple(self._leaves.values()), self.upstream)
        return meta

    def pose_backward(self) -> Tensor:
        """Compute the gradient with respect to the view matrix alone."""
        image, _, _ = rasterization(**(self._plain | {"viewmats": self._pose}))
        return torch.autograd.grad(image, self._pose, self.upstream)[0]

    def gradients(self) -> dict[str, Tensor]:
        """Return the gradients by name."""
        image, _, _ = rasterization(**(self._plain | self._leaves))
        found = torch.autograd.grad(image, tuple(self._leaves.values()), self.upstream)
        return dict(zip(self._leaves, found, strict=True))

    def state_bytes(self) -> int:
        """Return the memory that a render keeps until its backward pass."""
        return int(sum(rasterization(**self._plain)[2]["state_bytes"]))

    def best_work(self, runs: int) -> RasterWork:
        """Measure the least time of each stage over a few runs."""
        works = [raster_work(self.forward_backward())[0] for _ in range(runs)]
        stages = [name for name in RasterWork.__dataclass_fields__ if name.endswith("_ms")]
        return RasterWork(
            **{name: min(getattr(work, name) for work in works) for name in stages},
            evaluated_pairs=works[0].evaluated_pairs,
        )


def run_loss(settings: RasterSettings, results: Results) -> None:
    """Measure the fused L1 + D-SSIM with its gradient."""
    width, height = (48, 32) if settings.quick else (640, 480)
    rendered = torch.rand(height, width, 3).requires_grad_()
    target = torch.rand(height, width, 3)

    def step() -> Tensor:
        return torch.autograd.grad(l1_dssim(rendered, target), rendered)[0]

    results.add_time(
        f"loss {width}x{height}", "forward+backward", measure(step, runs=settings.runs, budget_s=settings.budget_s)
    )


def run_peers(settings: RasterSettings, results: Results, report_progress: ReportProgress) -> None:
    """Measure every peer on the first two scenes: its times, ratios to splatbot's, and differences."""
    size = settings.sizes[0]
    for scene in scenes_of(settings)[:2]:
        case = case_name(scene, size, 1)
        passes = Passes(scene, size, "RGB")
        own_forward = measure(passes.forward, runs=settings.runs, budget_s=settings.budget_s)
        own_both = measure(passes.forward_backward, runs=settings.runs, budget_s=settings.budget_s)
        results.add_time(case + ", RGB", "forward", own_forward)
        results.add_time(case + ", RGB", "forward+backward", own_both)
        grad = passes.upstream[0]
        for peer in all_peers():
            results.add(case + ", RGB", "implementation", None, "", peer=peer.name, note=peer.note)
            if peer.render is None:
                results.add(case + ", RGB", "forward", None, "ms", peer=peer.name, note="absent")
                continue
            report_progress(f"{case}: {peer.name}")
            forward = measure(partial(peer.render, scene, *size, None), runs=3, budget_s=settings.budget_s)
            both = measure(partial(peer.render, scene, *size, grad), runs=3, budget_s=settings.budget_s)
            theirs = peer.render(scene, *size, grad)
            _add_peer(results, case + ", RGB", peer.name, (forward, both), (own_forward, own_both))
            _compare(results, case + ", RGB", peer.name, passes, theirs.image, theirs.gradients)


def _add_peer(
    results: Results, case: str, peer: str, theirs: tuple[Timing, Timing], ours: tuple[Timing, Timing]
) -> None:
    for metric, their, our in zip(("forward", "forward+backward"), theirs, ours, strict=True):
        results.add_time(case, metric, their, peer=peer)
        results.add(case, f"{metric}, ratio to splatbot", their.least_ms / our.least_ms, "x", peer=peer)


def _compare(
    results: Results, case: str, peer: str, passes: Passes, image: Tensor, gradients: dict[str, Tensor]
) -> None:
    """Compare image and gradients with those of a peer; images may differ at discontinuities of the model."""
    error = (passes.forward()[0] - image).abs().amax(-1)
    results.add(case, "image, error of 99.9 % of the pixels", float(error.flatten().quantile(0.999)), "", peer=peer)
    results.add(case, "image, pixels that differ by over 1e-4", float((error > 1e-4).sum()), "px", peer=peer)
    own = passes.gradients()
    # The image of a round Gaussian does not depend on its quaternion, so that gradient is rounding error.
    names = (own.keys() & gradients.keys()) - ({"quats"} if passes.round else set())
    differences = {k: float((gradients[k] - own[k]).norm() / own[k].norm().clamp_min(1e-30)) for k in sorted(names)}
    for name, relative in differences.items():
        results.add(case, f"gradient of {name}, relative difference", relative, "", peer=peer)
    results.add(case, "gradients, largest relative difference", max(differences.values()), "", peer=peer)
