"""`splatbot bench twin`: cost of a step, cost of each effect, and error of the time step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from tyro.conf import Suppress, UseAppendAction, arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table, per_row
from splatbot.bench.twin.bounds import broken_bounds
from splatbot.errors import InputError


@dataclass(frozen=True)
class TwinSettings(Settings):
    """Measure the twin.

    The benchmark measures the cost of a step with and without the clutter of a map, awake and asleep. It measures the
    cost of each effect, alone and together, and the error over the time step. It follows planned paths among the true
    shapes, and paths pushed into an obstacle. It compares the picture of a robot among Gaussians with that of the true
    shapes. The exit code is 1 if a value exceeds its bounds.

    Examples:
        splatbot bench twin
        splatbot bench twin --paths 20 --scene wiping
        splatbot bench twin --quick --json figures.json

    Args:
        paths: Number of paths to plan and follow.
        scene: Scene whose effects are measured; repeat it for several. By default all shipped scenes.
        steps: Physics steps to time; the least of nine parts counts.
        budget_ms: Time budget of each plan [ms].
        gaussians: Gaussians of the map to plan in.
        timesteps: Time steps [s]; the reference is ten times finer than the finest.
        poses: Poses of the composite pictures.
    """

    name: ClassVar[str] = "twin"
    quick_values: ClassVar[Mapping[str, Any]] = {
        "steps": 90,
        "paths": 2,
        "budget_ms": 50.0,
        "gaussians": 4000,
        "timesteps": (0.004, 0.008),
        "poses": 2,
    }

    paths: Annotated[int, arg(metavar="N")] = 200
    scene: Annotated[tuple[str, ...], arg(metavar="NAME"), UseAppendAction] = ()
    steps: Suppress[int] = 9000
    budget_ms: Suppress[float] = 28.0
    gaussians: Suppress[int] = 50_000
    timesteps: Suppress[tuple[float, ...]] = (0.0005, 0.001, 0.002, 0.004, 0.008)
    poses: Suppress[int] = 20

    def validate(self) -> None:
        """Raise an InputError for a number of paths below 1."""
        if self.paths < 1:
            raise InputError(f"is {self.paths}.", field="--paths", hint="give a positive number")


def _measure(settings: TwinSettings, report_progress: ReportProgress) -> Results:
    from splatbot.bench.twin.costs import run_twin

    return run_twin(settings, report_progress)


BENCHMARK = Benchmark(TwinSettings, _measure, tables=(Table("Twin", layout=per_row),), violations=broken_bounds)
