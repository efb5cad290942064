"""The machine that figures belong to."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from splatbot import __version__
from splatbot.bench.native import bench_native
from splatbot.rasterize.native import native


def describe_machine(thread_counts: Sequence[int], *, peak_ms: float) -> dict[str, Any]:
    """Return CPU, versions, load and the measured peak of multiply-adds [GFLOP/s] by instruction set and threads.

    Args:
        thread_counts: to measure the peak for.
        peak_ms: how long to measure each peak [ms].
    """
    names = native().available_isas()
    peaks = {name: {str(count): measured_peak(name, count, peak_ms) for count in thread_counts} for name in names}
    return {
        "cpu": _cpu_name(),
        "cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "isa": native().isa(),
        "fma_peak_gflops": peaks,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "splatbot": __version__,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def raise_peaks(machine: dict[str, Any], count: int, *, peak_ms: float) -> None:
    """Measure the peak of the kernels in use once more; a busy moment must not pass for the machine's best."""
    peaks = machine["fma_peak_gflops"][machine["isa"]]
    peaks[str(count)] = max(peaks[str(count)], measured_peak(machine["isa"], count, peak_ms))


def measured_peak(name: str, count: int, milliseconds: float) -> float:
    """Measure GFLOP/s of independent multiply-adds (two operations each; without FMA a product and a sum)."""
    return float(bench_native().multiply_add_peak(name, count, milliseconds))


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        if line.lower().startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
