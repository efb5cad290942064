"""`splatbot bench collision`: speed and memory of the collision field, and its errors against exact ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import Suppress, arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table, cases, per_metric, per_row
from splatbot.errors import InputError


@dataclass(frozen=True)
class CollisionSettings(Settings):
    """Measure the collision field and an arm of spheres in it.

    The benchmark measures build and update times, memory, and queries per second. It also measures false free and
    false hit rates against exact ground truth, over n_sigma and over the methods that check edges. Floaters are added
    to a map, to measure which queries they block.

    Examples:
        splatbot bench collision
        splatbot bench collision --peers
        splatbot bench collision --run runs/latest
        splatbot bench collision --quick --json figures.json

    Args:
        peers: Also measure other collision checkers (minutes).
        threads: Numbers of threads.
        run: Run folder of splatbot map; its field is compared with the raw depth of its log.
        counts: Numbers of Gaussians.
        configurations: Configurations of the arm in a timed query.
        audited: Configurations that are compared with the ground truth.
        audited_edges: Certified edges that are compared with the ground truth.
    """

    name: ClassVar[str] = "collision"
    quick_values: ClassVar[Mapping[str, Any]] = {
        "counts": (2000, 4000),
        "configurations": 2000,
        "audited": 2000,
        "audited_edges": 100,
    }

    peers: bool = False
    threads: Annotated[tuple[int, ...], arg(metavar="N ...")] = (1, 2)
    run: Annotated[Path | None, arg(metavar="DIR")] = None
    counts: Suppress[tuple[int, ...]] = (10_000, 50_000, 200_000, 500_000)
    configurations: Suppress[int] = 200_000
    audited: Suppress[int] = 1_000_000
    audited_edges: Suppress[int] = 100_000

    def validate(self) -> None:
        """Raise an InputError for a number of threads below 1."""
        if not self.threads or min(self.threads) < 1:
            raise InputError(f"is {self.threads}.", field="--threads", hint="give positive numbers, as in 1 2")

    @property
    def truth_step(self) -> float:
        """Cell size [m] of the grid of the ground truth."""
        return 0.1 if self.quick else 0.02

    @property
    def runs(self) -> int:
        """Repetitions of a measurement."""
        return 1 if self.quick else 9

    @property
    def reference(self) -> int:
        """Number of Gaussians of the map whose errors are measured."""
        return 4000 if self.quick else 200_000


def _measure(settings: CollisionSettings, report_progress: ReportProgress) -> Results:
    from splatbot.bench.collision.accuracy import run_collision

    return run_collision(settings, report_progress)


def _plot(results: Results, folder: Path) -> None:
    from splatbot.bench.collision.plots import plot_accuracy, plot_sigma

    plot_accuracy(results, folder)
    plot_sigma(results, folder)


BENCHMARK = Benchmark(
    CollisionSettings,
    _measure,
    tables=(
        Table("Speed and memory", lambda row: row.peer is None and " Gaussians, " in row.case, layout=per_metric),
        Table("Configurations against the ground truth", cases("sweep n_sigma")),
        Table("Packed storage against the ground truth", cases("sweep storage")),
        Table("Edges against the ground truth", cases("sweep edges")),
        Table("Floaters", cases("gate")),
        Table(
            "Maps made from images",
            lambda row: row.peer is None and (row.case.startswith("mapped") or row.case.endswith("in free space")),
            layout=per_metric,
        ),
        Table("Comparison with peers", cases("points against", "configurations, "), layout=per_row),
    ),
    plot=_plot,
)
