"""A benchmark: its settings, its measurement, and the tables and plots of its results.

A benchmark is one module that defines ``BENCHMARK``, and one line in :data:`BENCHMARKS`. `splatbot bench NAME` takes
its options and its help from the settings. The module may be a package, which imports its measurement only to run it,
so that `--help` does not wait for torch or open3d.
"""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, cast

from tyro.conf import arg

from splatbot.bench.results import Results
from splatbot.bench.tables import Table
from splatbot.errors import InputError

ReportProgress = Callable[[str], None]


def ignore_progress(text: str) -> None:
    """Drop a message on progress."""


class Entry(NamedTuple):
    """A registered benchmark: its module, and the summary that `splatbot bench --help` shows without importing it."""

    module: str
    summary: str


BENCHMARKS = {
    "twin": Entry("splatbot.bench.twin", "Measure the twin: cost of each effect, error against the time step."),
    "raster": Entry("splatbot.bench.raster", "Measure the rasterizer: speed, and error against time."),
    "tracking": Entry("splatbot.bench.tracking", "Measure tracking: error against time, compared with other trackers."),
    "training": Entry("splatbot.bench.training", "Measure training: quality of held-out views against seconds."),
    "collision": Entry("splatbot.bench.collision", "Measure the collision field: queries per second, errors."),
    "thin": Entry("splatbot.bench.thin", "Measure missed probes on thin, transparent and black objects."),
    "planning": Entry("splatbot.bench.planning", "Measure the planner: paths over time budgets, checked exactly."),
    "grasping": Entry("splatbot.bench.grasping", "Measure grasping: candidates per second, errors of the contacts."),
    "logs": Entry("splatbot.bench.logs", "Measure the reading of logs: frames per second of each layout."),
    "service": Entry("splatbot.bench.service", "Measure the service: mapping under queries, and the cost of HTTP."),
    "sizing": Entry("splatbot.bench.sizing", "Measure costs of the service; plan and simulate a fleet from them."),
}


@dataclass(frozen=True)
class Settings:
    """Options of every benchmark; a subclass adds its own and documents them under "Args:".

    Args:
        out: Folder for the JSON and CSV files and the plots. If not given, runs/bench-NAME.
        json: Additional path for the JSON file.
        csv: Additional path for the CSV file.
        quick: Run a tiny workload, to check that the benchmark runs: seconds, or a minute on a busy machine.
        redraw: Do not measure; draw the plots again from the JSON file in the folder.
    """

    name: ClassVar[str]
    quick_values: ClassVar[Mapping[str, Any]] = {}
    """Values that replace those of the fields with ``quick``."""

    out: Annotated[Path | None, arg(metavar="DIR")] = None
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    csv: Annotated[Path | None, arg(metavar="FILE")] = None
    quick: bool = False
    redraw: bool = False

    def validate(self) -> None:
        """Raise an InputError for a value that makes no sense."""

    @property
    def stem(self) -> str:
        """Name of the written files, without suffix."""
        return self.name

    @property
    def folder(self) -> Path:
        """Folder of the written files."""
        return self.out if self.out is not None else Path("runs") / f"bench-{self.name}"

    @property
    def peak_ms(self) -> float:
        """Duration [ms] of the measurement of the machine's peak, for each instruction set and number of threads."""
        return 20.0 if self.quick else 200.0

    def save(self, results: Results) -> None:
        """Write the JSON file; a measurement calls it after each of its parts."""
        results.write_json(self.folder / f"{self.stem}.json")


@dataclass(frozen=True)
class Benchmark:
    """The measurement and the tables of `splatbot bench NAME`.

    Args:
        settings: The class of the settings; its docstring is the help of the command.
        measure: Measures with such settings, reports its progress, and returns the results.
        tables: The tables to print, in this order; empty ones are left out.
        plot: Writes the plots of the results into a folder.
        violations: Returns a message for each figure out of its bounds; any of them makes the exit code 1. It is not
            called with ``quick``.
    """

    settings: type[Settings]
    measure: Callable[[Any, ReportProgress], Results]
    tables: Sequence[Table]
    plot: Callable[[Results, Path], None] = lambda results, folder: None
    violations: Callable[[Results], list[str]] = lambda results: []

    def run(self, settings: Settings, report_progress: ReportProgress = ignore_progress) -> Results:
        """Measure, and write the JSON and CSV files and the plots; with ``redraw`` only the plots.

        Ctrl-C before the first results removes the folder if this run made it.

        Raises:
            InputError: A setting makes no sense, or there are no results to draw.
        """
        if settings.redraw:
            return self._redraw(settings.folder, settings.folder / f"{settings.stem}.json")
        settings.validate()
        if settings.quick:
            settings = replace(settings, **settings.quick_values)
        is_new = not settings.folder.exists()
        settings.folder.mkdir(parents=True, exist_ok=True)
        try:
            results = self.measure(settings, report_progress)
        except KeyboardInterrupt:
            if is_new and not (settings.folder / f"{settings.stem}.json").exists():
                shutil.rmtree(settings.folder)  # it has no results, only logs of programs
            raise
        settings.save(results)
        results.write_csv(settings.folder / f"{settings.stem}.csv")
        if settings.json is not None:
            results.write_json(settings.json)
        if settings.csv is not None:
            results.write_csv(settings.csv)
        self.plot(results, settings.folder)
        return results

    def _redraw(self, folder: Path, file: Path) -> Results:
        results = Results.read_json(file)
        try:
            self.plot(results, folder)
        except (LookupError, TypeError, ValueError) as error:
            why = f"has not the results that this version plots ({type(error).__name__}: {error})."
            raise InputError(why, file=file, hint="run the benchmark again") from error
        return results


def load_benchmark(name: str) -> Benchmark:
    """Import the benchmark of that name in :data:`BENCHMARKS`."""
    return cast(Benchmark, importlib.import_module(BENCHMARKS[name].module).BENCHMARK)
