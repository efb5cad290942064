"""`splatbot bench NAME`: the command of each benchmark, generated from its settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table as RichTable

from splatbot.bench.benchmark import load_benchmark
from splatbot.cli.drawing import draw_offscreen
from splatbot.cli.help import parsed
from splatbot.cli.tables import print_columns, wide_console

_BUSY_LOAD = 0.5  # load average above which other programs slow the measurement down


def run_benchmark(name: str, words: Sequence[str]) -> int:
    """Parse the options, run the benchmark, and print its tables; return the exit code."""
    benchmark = load_benchmark(name)
    settings = parsed(benchmark.settings, f"splatbot bench {name}", words)
    draw_offscreen()  # before any import of mujoco
    results = benchmark.run(settings, _report_progress)
    console = wide_console()
    _print_machine(console, results.machine)
    for table in benchmark.tables:
        for part in table.render(results.rows):
            if isinstance(part, RichTable):
                print_columns(part, console)
            else:
                console.print(part)
    console.print(f"written to {settings.folder}")
    violations = benchmark.violations(results) if not settings.quick else []
    for violation in violations:
        console.print(f"[red]{violation}[/red]")
    return 1 if violations else 0


def _report_progress(text: str) -> None:
    """Print the current measurement on stderr."""
    Console(stderr=True).print(f"[dim]{text} ...[/dim]", highlight=False)


def _print_machine(console: Console, machine: Mapping[str, Any]) -> None:
    """Print the machine, and a warning if other programs loaded it."""
    peaks = machine["fma_peak_gflops"][machine["isa"]].items()
    peak = ", ".join(f"{gflops:.0f} GFLOP/s (threads: {count})" for count, gflops in peaks)
    console.print(f"{machine['cpu']}, {machine['cpus']} CPUs, kernels {machine['isa']}, peak {peak}")
    load = machine["load_1min"]
    if load is not None and load > _BUSY_LOAD:
        console.print(f"[yellow]the machine was busy (load {load}): times are upper bounds[/yellow]")
