"""Figures of a benchmark as tables on stdout."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from splatbot.bench.results import Row

_FILE_WIDTH = 160  # [characters] where there is no terminal to ask


def wide_console() -> Console:
    """Stdout, as wide as the terminal, or 160 characters in a file."""
    return Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)


def say_progress(text: str) -> None:
    """What is being measured, on stderr."""
    Console(stderr=True).print(f"[dim]{text} ...[/dim]", highlight=False)


def tell_machine(console: Console, machine: Mapping[str, Any], *more: str) -> None:
    """What measured, and whether other programs took its time, which makes the figures upper bounds."""
    console.print(", ".join((f"{machine['cpu']}, {machine['cpus']} CPUs, kernels {machine['isa']}", *more)))
    load = machine["load_1min"]
    if load is not None and load > 0.5:
        console.print(f"[yellow]the machine was busy (load {load}): times are upper bounds[/yellow]")


def figure_table(title: str, rows: Iterable[Row], metrics: Sequence[str] | None = None) -> Table:
    """A line per case and peer, a column per metric, of all if none are named; a case without figures shows why."""
    table = Table(title=title)
    grouped: dict[str, dict[str, Row]] = {}
    found_metrics: dict[str, None] = {}
    for row in rows:
        grouped.setdefault(f"{row.case}: {row.peer}" if row.peer else row.case, {})[row.metric] = row
        found_metrics[row.metric] = None
    metrics = list(found_metrics) if metrics is None else metrics
    table.add_column("case")
    for metric in metrics:
        table.add_column(metric, justify="right")
    for case, found in grouped.items():
        cells = [figure_text(found[metric]) if metric in found else "" for metric in metrics]
        if any(cells):
            table.add_row(case, *cells)
    return table


def figure_text(row: Row) -> str:
    if row.value is None:
        return row.note or "-"
    median = f" ({row.value + row.spread:.2f})" if row.spread is not None else ""
    digits = f"{row.value:.2f}" if row.unit == "ms" else f"{row.value:.3g}"
    return f"{digits}{median}" if row.unit == "ms" else f"{digits} {row.unit}".rstrip()


def metric_table(title: str, rows: Iterable[Row]) -> Table:
    """A line per metric, a column per case and peer; a figure that is missing shows why."""
    cells: dict[str, dict[str, str]] = {}
    cases: dict[str, None] = {}
    for row in rows:
        case = f"{row.case}: {row.peer}" if row.peer else row.case
        counted = row.unit.startswith("of ")
        text = (row.note or "-") if row.value is None else f"{row.value:.4g}{' ' + row.unit if counted else ''}"
        cells.setdefault(row.metric if counted else f"{row.metric} [{row.unit}]", {})[case] = text
        cases[case] = None
    table = Table(title=title)
    table.add_column("")
    for case in cases:
        table.add_column(case, justify="right")
    for metric, values in cells.items():
        table.add_row(metric, *(values.get(case, "") for case in cases))
    return table
