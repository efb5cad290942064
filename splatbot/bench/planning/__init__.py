"""`splatbot bench planning`: paths over time budgets, checked against exact ground truth, and compared with peers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import Suppress, arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table, cases, per_metric
from splatbot.errors import InputError

BUDGET, AGAINST = "budget", "against"
FAR_CHANGE, NEAR_CHANGE, MEMORY = "a far change", "a change on the path", "memory"


@dataclass(frozen=True)
class PlanningSettings(Settings):
    """Measure the planner on a table top of exact shapes.

    The benchmark measures solved problems, time, cost and clearance over time budgets. It counts the paths that touch
    the true shapes. It also measures the time to certify or repair a path after a change of the map. With --mapped or
    --run it plans on maps made from images instead, over margins.

    Examples:
        splatbot bench planning
        splatbot bench planning --peers
        splatbot bench planning --budgets 10 10000 --problems 10
        splatbot bench planning --mapped --run runs/desk runs/kitchen
        splatbot bench planning --quick --json figures.json

    Args:
        peers: Also measure other planners and maps (minutes).
        budgets: Time budgets of the planner [ms].
        problems: Number of problems.
        seeds: Seeds of each problem, for budgets up to 100 ms; longer budgets use one.
        mapped: Plan on the map that SLAM builds from a noisy film of the table top instead (minutes).
        run: Run folders of splatbot map: plan problems in each map instead, or in addition with --mapped. The
            scene.yaml of the log places the arm.
        margins: Also sweep the margin on each run: missed surface, false hits and solved problems, with a plot.
        gaussians: Gaussians of the map.
        peer_budgets: Time budgets [ms] of peers that improve a path until the time is over.
        film: Frames of the noisy film, and the width of its images [px].
        run_problems: Number of problems in the map of each run.
    """

    name: ClassVar[str] = "planning"
    quick_values: ClassVar[Mapping[str, Any]] = {
        "gaussians": 5000,
        "problems": 3,
        "seeds": 2,
        "budgets": (28.0, 100.0),
        "peer_budgets": (28.0,),
        "film": (24, 160),
        "run_problems": 2,
    }

    peers: bool = False
    budgets: Annotated[tuple[float, ...], arg(metavar="MS ...")] = (1.0, 3.0, 10.0, 28.0, 100.0, 1000.0)
    problems: int = 50
    seeds: int = 10
    mapped: bool = False
    run: Annotated[tuple[Path, ...], arg(metavar="DIR ...")] = ()
    margins: bool = False
    gaussians: Suppress[int] = 50_000
    peer_budgets: Suppress[tuple[float, ...]] = (28.0, 100.0, 1000.0)
    film: Suppress[tuple[int, int]] = (120, 320)
    run_problems: int = 100

    def validate(self) -> None:
        """Raise an InputError for options that exclude each other, and for numbers that are not positive."""
        if self.peers and self.on_maps:
            raise InputError("has no effect with --mapped or --run.", field="--peers", hint="run it separately")
        if self.margins and not self.run:
            raise InputError("needs a run.", field="--margins", hint="give --run DIR")
        if not self.budgets or not min(self.budgets) > 0 or self.problems < 1 or self.seeds < 1:
            raise InputError(
                "is empty or has a number that is not above 0.",
                field="--budgets, --problems, --seeds",
                hint="give positive numbers",
            )

    @property
    def on_maps(self) -> bool:
        """True if the maps are made from images."""
        return self.mapped or bool(self.run)

    @property
    def stem(self) -> str:
        """Name of the written files, without suffix."""
        return "planning-mapped" if self.on_maps else "planning"

    @property
    def memory_gaussians(self) -> int:
        """Gaussians of the map whose memory is measured."""
        return self.gaussians if self.quick else 150_000


def _measure(settings: PlanningSettings, report_progress: ReportProgress) -> Results:
    from splatbot.bench.planning.budgets import run_mapped, run_planning

    return (run_mapped if settings.on_maps else run_planning)(settings, report_progress)


def _plot(results: Results, folder: Path) -> None:
    from splatbot.bench.planning.margin_sweep import plot_margins
    from splatbot.bench.planning.plots import plot_cost

    plot_margins(results, folder)
    plot_cost(results, folder)


_EXACT_CASES = (BUDGET, FAR_CHANGE, NEAR_CHANGE, MEMORY)

BENCHMARK = Benchmark(
    PlanningSettings,
    _measure,
    tables=(
        Table("By time budget", cases(BUDGET, peers=False), layout=per_metric),
        Table("Changes of the map, and memory", cases(*_EXACT_CASES[1:], peers=False), layout=per_metric),
        Table("Peers", lambda row: row.peer is not None and AGAINST not in row.case),
        Table("Costs relative to those of a peer", lambda row: row.peer is not None and AGAINST in row.case),
        Table(
            "Maps made from images",
            lambda row: row.peer is None and not row.case.startswith(_EXACT_CASES),
            layout=per_metric,
            split_by=lambda row: row.case.split(", margin")[0],
        ),
    ),
    plot=_plot,
)
