"""Repeated measurements in one process."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splatbot.rasterize.native import native, one_torch_thread


@dataclass(frozen=True)
class Timing:
    """Wall times of several runs [ms]. Other programs raise the median more than the least."""

    least_ms: float
    median_ms: float
    runs: int


def measure(function: Callable[[], object], *, runs: int, budget_s: float = 2.0) -> Timing:
    """Time ``function`` ``runs`` times, or fewer if the budget is spent.

    A first run warms up and does not count, unless it alone spends the budget.
    """
    first = _milliseconds(function)
    samples = [first] if first > 1e3 * budget_s else []
    end = time.perf_counter() + budget_s
    while len(samples) < runs and (not samples or (time.perf_counter() < end and first <= 1e3 * budget_s)):
        samples.append(_milliseconds(function))
    return Timing(min(samples), statistics.median(samples), len(samples))


def _milliseconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return 1e3 * (time.perf_counter() - start)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Run the kernels on ``count`` threads, and torch on one: its threads spin and would starve the kernels'."""
    native().set_num_threads(count)
    try:
        with one_torch_thread():
            yield
    finally:
        native().set_num_threads(0)


@contextmanager
def isa(name: str) -> Iterator[None]:
    """Run the kernels of one instruction set."""
    native().set_isa(name)
    try:
        yield
    finally:
        native().set_isa("")


def peak_memory(function: Callable[[], object]) -> int | None:
    """Return the peak memory [bytes] of the process during one run. If None, the system does not report it."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # forget the earlier peak
    except OSError:
        return None
    function()
    return _memory("VmHWM")


@contextmanager
def memory_peak() -> Iterator[Callable[[], int | None]]:
    """Yield a function that returns the peak memory [bytes] since the block began. If None, it is unknown."""
    known = True
    try:
        Path("/proc/self/clear_refs").write_text("5")  # forget the earlier peak
    except OSError:
        known = False
    yield lambda: _memory("VmHWM") if known else None


def _memory(field: str) -> int | None:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    return None
