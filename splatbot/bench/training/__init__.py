"""`splatbot bench training`: quality of held-out views against seconds of training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table
from splatbot.errors import InputError

Knob = Literal["strategy", "max_gaussians", "sh_degree", "coarse_share", "scale"]


@dataclass(frozen=True)
class TrainingBenchSettings(Settings):
    """Train one scene several times for the same time, one knob at a time, and score the held-out views.

    Without a dataset, the scene is the simulated tabletop: 60 exact images with exact poses.

    Examples:
        splatbot bench training
        splatbot bench training --dataset scenes/lego --minutes 5 --knobs strategy max_gaussians
        splatbot bench training --quick

    Args:
        dataset: A COLMAP, Blender or Nerfstudio scene.
        minutes: Time of each training.
        knobs: Settings to vary, each around the default.
        scale: The images are reduced to 1/S of their size.
        seed: Seed of the random draws.
    """

    name: ClassVar[str] = "training"
    quick_values: ClassVar[Mapping[str, Any]] = {"minutes": 0.05, "knobs": ("strategy",)}

    dataset: Annotated[Path | None, arg(metavar="DIR")] = None
    minutes: Annotated[float, arg(metavar="MIN")] = 1.0
    knobs: tuple[Knob, ...] = ("strategy", "max_gaussians", "sh_degree", "coarse_share", "scale")
    scale: Annotated[int, arg(metavar="S")] = 1
    seed: int = 0

    def validate(self) -> None:
        """Raise an InputError for no time, or a scale below 1."""
        if not self.minutes > 0:
            raise InputError(f"is {self.minutes:g}.", field="--minutes", hint="give minutes above 0")
        if self.scale < 1:
            raise InputError(f"is {self.scale}.", field="--scale", hint="give 1 for full size, or 2, 4, 8")


def _measure(settings: TrainingBenchSettings, report_progress: ReportProgress) -> Results:
    from splatbot.bench.training.sweep import run_sweep

    return run_sweep(settings, report_progress)


def _plot(results: Results, folder: Path) -> None:
    from splatbot.bench.training.plots import plot_training

    plot_training(results, folder)


BENCHMARK = Benchmark(
    TrainingBenchSettings,
    _measure,
    tables=(Table("Held-out views after the same time; (default) marks the default setting"),),
    plot=_plot,
)
