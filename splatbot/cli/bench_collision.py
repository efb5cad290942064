"""What `splatbot bench collision` prints."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from splatbot.bench.results import Results, Row

_FILE_WIDTH = 160  # [characters] where there is no terminal to ask


def print_collision(results: Results, folder: Path) -> None:
    """A table of speed with a column per case, one of errors with a line per case, and the peers."""
    console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
    machine = results.machine
    console.print(f"{machine['cpu']}, {machine['cpus']} CPUs, kernels {machine['isa']}")
    if machine["load_1min"] is not None and machine["load_1min"] > 0.5:
        console.print(f"[yellow]the machine was busy (load {machine['load_1min']}): times are upper bounds[/yellow]")
    own = [row for row in results.rows if row.peer is None]
    console.print(_by_metric("Speed and memory", [row for row in own if " Gaussians, " in row.case]))
    for title, prefix in (
        ("Configurations against exact truth", "sweep n_sigma"),
        ("Edges against exact truth", "sweep edges"),
        ("Floaters", "gate"),
    ):
        console.print(_by_case(title, results.select(prefix)))
    maps = [row for row in own if row.case.startswith("mapped") or row.case.endswith("points in free space")]
    console.print(_by_metric("Maps made from images", maps))
    rest = [row for row in results.rows if row.case.startswith(("points against", "configurations, "))]
    if rest:
        table = Table("case", "metric", "whose", "figure", title="Beside peers")
        for row in rest:
            table.add_row(row.case, row.metric, row.peer or "splatbot", _figure(row))
        console.print(table)
    console.print(f"written to {folder}")


def _by_metric(title: str, rows: Iterable[Row]) -> Table:
    cells: dict[str, dict[str, str]] = {}
    cases: dict[str, None] = {}
    for row in rows:
        cells.setdefault(f"{row.metric} [{row.unit}]", {})[row.case] = _value(row)
        cases[row.case] = None
    table = Table(title=title)
    table.add_column("")
    for case in cases:
        table.add_column(case, justify="right")
    for metric, values in cells.items():
        table.add_row(metric, *(values.get(case, "") for case in cases))
    return table


def _by_case(title: str, rows: Iterable[Row]) -> Table:
    cells: dict[str, dict[str, str]] = {}
    metrics: dict[str, None] = {}
    for row in rows:
        cells.setdefault(row.case, {})[row.metric] = _figure(row)
        metrics[row.metric] = None
    table = Table(title=title)
    table.add_column("case")
    for metric in metrics:
        table.add_column(metric, justify="right")
    for case, values in cells.items():
        table.add_row(case, *(values.get(metric, "") for metric in metrics))
    return table


def _value(row: Row) -> str:
    return "-" if row.value is None else f"{row.value:.3g}"


def _figure(row: Row) -> str:
    return row.note or "-" if row.value is None else f"{row.value:.6g} {row.unit}".rstrip()
