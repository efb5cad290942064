"""Measurements of a range of simulated scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from splatbot.bench.benchmark import ReportProgress
from splatbot.rasterize.native import one_torch_thread

_T = TypeVar("_T")


def over_scenes(
    seeds: range, measure: Callable[[int], Sequence[_T]], what: str, report_progress: ReportProgress
) -> list[_T]:
    """Collect the rows that ``measure`` returns for each seed of a scene, on one thread.

    Args:
        seeds: seeds of the scenes.
        measure: returns the rows of one scene.
        what: name of the rows in progress lines.
        report_progress: receives a line before each scene.
    """
    rows: list[_T] = []
    with one_torch_thread():
        for seed in seeds:
            report_progress(f"scene {seed}, {len(rows)} {what} so far")
            rows += measure(seed)
    return rows
