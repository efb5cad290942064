"""Hard logs with exact truth: each frame is tracked within a bound or reported; the map stays true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.results import Results
from splatbot.bench.tracking import AFTER, DEGRADED, LOST, RECOVERY, SILENT, STRESS, VIEWS, WORST
from splatbot.config import Config
from splatbot.evaluation import psnr
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.logs import Log, open_log
from splatbot.rasterize.views import render_view
from splatbot.slam import FrameResult, Slam

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StressCase:
    """One hard log.

    Args:
        name: the difficulty.
        log: scene, trajectory and effects of the synthetic log, without size and length. ``{at}`` and ``{end}`` are
            replaced by the first frame of the bad stretch and the first good frame after it.
        bound_m: error [m] within which a frame counts as tracked.
        stretch: shares of the log between which it is bad. If None, all of it is.
        rate: of the log [Hz].
        blind: whether nothing can be seen in the bad stretch: each of its frames has to be lost.
    """

    name: str
    log: str
    bound_m: float
    stretch: tuple[float, float] | None = None
    rate: float = 30.0
    blind: bool = False

    def uri(self, frames: int, width: int) -> str:
        """Return the URI of the log."""
        at, end = self.bad(frames)
        size = f"frames={frames}&width={width}&height={width * 3 // 4}&rate={self.rate:g}"
        joined = "&" if "?" in self.log else "?"
        text = f"{self.log}{joined}{size}"
        for name, value in (("{at}", at), ("{end}", end), ("{n}", end - at), ("{event}", at / self.rate)):
            text = text.replace(name, f"{value:g}")
        return f"synthetic:{text}"

    def bad(self, frames: int) -> tuple[int, int]:
        """Return the first bad frame, and the first good one after it."""
        if self.stretch is None:
            return 0, frames
        return round(self.stretch[0] * frames), round(self.stretch[1] * frames)


CASES = (
    StressCase("flat textured wall", "wall", 0.010),
    StressCase("flat blank wall", "wall_blank", 0.010),
    StressCase("corridor", "corridor", 0.030),
    StressCase("pure rotation", "room?trajectory=rotation", 0.015),
    StressCase("steps of 8 cm and 5°", "room?trajectory=steps", 0.010),
    StressCase("40 % depth holes", "tabletop?effects=depth_holes:share=0.4", 0.005),
    StressCase("0.5 s of black frames", "tabletop?effects=blackout:at={at},n={n}", 0.005, (0.4, 0.6), 30.0, True),
    StressCase("exposure x 2", "tabletop?effects=exposure:step=2,at={at},until={end}", 0.005, (0.4, 0.7)),
    StressCase("exposure x 1/2", "tabletop?effects=exposure:step=0.5,at={at},until={end}", 0.005, (0.4, 0.7)),
    StressCase("a hand crosses", "tabletop_crossing?event={event}", 0.010, (0.2, 0.9)),
)


@dataclass(frozen=True)
class StressFigures:
    """Result on a hard log.

    Args:
        results: by frame; ``errors`` [m] of those with a pose, NaN of the others.
        silent: frames called "ok" whose error is above the bound.
        worst_m: largest error of a frame called "ok"; NaN without any.
        recovery: frames from the first good one until a frame is within the bound and none is lost after it. If None,
            tracking does not recover.
        after_m: largest error [m] from then on; NaN where none.
        worse_db: loss of PSNR [dB] over the bad stretch, in views of the map at up to five frames before it. NaN
            without such frames.
        same_map: whether no bit of the map changed in the bad stretch.
    """

    results: list[FrameResult]
    errors: Array
    silent: int
    worst_m: float
    recovery: int | None
    after_m: float
    worse_db: float
    same_map: bool

    def count(self, verdict: str) -> int:
        """Count the frames of that verdict."""
        return sum(result.verdict == verdict for result in self.results)


def run_case(case: StressCase, frames: int, width: int, config: Config) -> StressFigures:
    """Track and map a hard log."""
    log = open_log(case.uri(frames, width))
    truth = log.ground_truth
    if truth is None:
        raise ValueError("a synthetic log has a reference")
    slam = Slam(config)
    first, good = case.bad(len(log))
    before: GaussianModel | None = None
    after: GaussianModel | None = None
    errors = np.full(len(log), np.nan)
    for index in range(len(log)):
        if index == first:
            before = slam.snapshot().model
        result = slam.process(log[index])
        if result.T_world_camera is not None:
            T = inverse(truth.T_world_camera[0]) @ truth.T_world_camera[index]
            errors[index] = np.linalg.norm((inverse(T) @ result.T_world_camera)[:3, 3])
        if index == good - 1:
            after = slam.snapshot().model
    believed = np.array([r.verdict == "ok" for r in slam.results])
    recovery = _recovery(errors[good:], case.bound_m)
    tail = errors[good + recovery :] if recovery is not None else np.zeros(0)
    seen = [k for k in range(0, first, max(1, first // 4)) if slam.results[k].T_world_camera is not None]
    return StressFigures(
        results=slam.results,
        errors=errors,
        silent=int((errors[believed] > case.bound_m).sum()),
        worst_m=float(errors[believed].max()) if believed.any() else np.nan,
        recovery=recovery,
        after_m=float(np.nanmax(tail)) if np.isfinite(tail).any() else np.nan,
        worse_db=_quality(before, log, slam.results, seen) - _quality(after, log, slam.results, seen),
        same_map=before is not None and after is not None and _equal(before, after),
    )


def run_stress(
    results: Results,
    config: Config,
    *,
    frames: int,
    width: int,
    cases: tuple[StressCase, ...] = CASES,
    report_progress: ReportProgress = ignore_progress,
) -> None:
    """Add a row per figure of each case."""
    for case in cases:
        report_progress(f"{STRESS}: {case.name}")
        found = run_case(case, frames, width, config)
        name = f"{STRESS}: {case.name}"
        results.add(name, "bound", 1e3 * case.bound_m, "mm")
        results.add(name, SILENT, found.silent, "")
        results.add(name, WORST, _finite(1e3 * found.worst_m), "mm", note="none")
        results.add(name, DEGRADED, found.count("degraded"), "")
        results.add(name, LOST, found.count("lost"), "")
        if case.stretch is not None:
            never = None if found.recovery is not None else "never"
            results.add(name, RECOVERY, found.recovery and 1e3 * found.recovery / case.rate, "ms", note=never)
            results.add(name, AFTER, _finite(1e3 * found.after_m), "mm", note="none")
            results.add(name, VIEWS, _finite(found.worse_db), "dB", note="the same bits" if found.same_map else None)


def _recovery(errors: Array, bound: float) -> int | None:
    """Count the frames until one is within the bound with no lost frame after it."""
    lost = np.flatnonzero(~np.isfinite(errors))
    start = int(lost[-1]) + 1 if len(lost) else 0
    within = np.flatnonzero(errors[start:] <= bound)
    return start + int(within[0]) if len(within) else None


def _quality(model: GaussianModel | None, log: Log, results: Sequence[FrameResult], chosen: Sequence[int]) -> float:
    """Compute the mean PSNR [dB] of views of the map against their frames; NaN without frames."""
    if model is None or not chosen:
        return np.nan
    values = []
    for index in chosen:
        T, frame = results[index].T_world_camera, log[index]
        if T is not None:
            values.append(psnr(render_view(model, frame.camera, T).clip(0.0, 1.0), frame.rgb))
    return float(np.mean(values)) if values else np.nan


def _equal(a: GaussianModel, b: GaussianModel) -> bool:
    return all(torch.equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
