"""Costs and counts of a run, under the stable keys of ``metrics.json``."""

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
    """Count the processed frames and summarize their times."""
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
    """Compute the 50th, 95th and 99th percentile, or None for an empty sequence."""
    if not values:
        return {f"p{p}": None for p in _PERCENTILES}
    return {f"p{p}": float(v) for p, v in zip(_PERCENTILES, np.percentile(values, _PERCENTILES), strict=True)}


def stage_percentiles(rows: Sequence[FrameRow]) -> dict[str, dict[str, float | None]]:
    """Compute for each stage the percentiles [ms] over its frames, their number and the sum [ms]."""
    spent = {name: [row.stage_ms[name] for row in rows if name in row.stage_ms] for name in stage_names(rows)}
    return {
        name: {**percentiles(values), "frames": len(values), "total": float(sum(values))}
        for name, values in spent.items()
    }


def stage_names(rows: Sequence[FrameRow]) -> list[str]:
    """Return the names of all stages, in the order of the frame with the most stages."""
    fullest = max(rows, key=lambda row: len(row.stage_ms), default=None)
    return list(
        dict.fromkeys([*(fullest.stage_ms if fullest else ()), *(name for row in rows for name in row.stage_ms)])
    )


def peak_rss_bytes() -> int:
    """Return the peak resident memory of this process [bytes]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # Linux reports KiB


def without_nan(value: Any) -> Any:
    """Replace NaN and infinity, which JSON cannot represent, by None."""
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
