"""What a run cost and how it went, under the names that other programs read from ``metrics.json``."""

from __future__ import annotations

import math
import resource
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from splatbot.results.folder import FrameRow

_PERCENTILES = (50, 95, 99)


def cost_metrics(rows: Sequence[FrameRow]) -> dict[str, Any]:
    """Counts and times of the frames that were processed."""
    done = [row for row in rows if row.processed]
    return {
        "frames": len(done),
        "tracked": sum(row.tracked for row in done),
        "degraded": sum(row.verdict == "degraded" for row in done),
        "lost": sum(row.verdict == "lost" for row in done),
        "skipped": sum(row.verdict == "skipped" for row in rows),
        "dropped": sum(row.verdict == "dropped" for row in rows),
        "late": sum(row.late for row in done),
        "keyframes": sum(row.keyframe for row in done),
        "held_out": sum(row.held_out for row in done),
        "ms_per_frame": percentiles([row.ms for row in done]),
        "stages": stage_percentiles(done),
        "peak_rss_bytes": peak_rss_bytes(),
    }


def percentiles(values: Sequence[float]) -> dict[str, float | None]:
    """The 50th, 95th and 99th percentile; None of nothing."""
    if not values:
        return {f"p{p}": None for p in _PERCENTILES}
    return {f"p{p}": float(v) for p, v in zip(_PERCENTILES, np.percentile(values, _PERCENTILES), strict=True)}


def stage_percentiles(rows: Sequence[FrameRow]) -> dict[str, dict[str, float | None]]:
    """By stage: percentiles [ms] over the frames in which it ran, their number and the sum [ms]."""
    spent = {name: [row.stage_ms[name] for row in rows if name in row.stage_ms] for name in stage_names(rows)}
    return {
        name: {**percentiles(values), "frames": len(values), "total": float(sum(values))}
        for name, values in spent.items()
    }


def stage_names(rows: Sequence[FrameRow]) -> list[str]:
    """Names of all stages, in the order of the frame that ran the most of them."""
    fullest = max(rows, key=lambda row: len(row.stage_ms), default=None)
    return list(
        dict.fromkeys([*(fullest.stage_ms if fullest else ()), *(name for row in rows for name in row.stage_ms)])
    )


def peak_rss_bytes() -> int:
    """The largest resident memory of this process so far [bytes]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # Linux counts in KiB


def without_nan(value: Any) -> Any:
    """The same with null for numbers that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
