"""`splatbot bench grasping`: candidates per second, time to a ranked list, and errors against exact shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table, per_metric
from splatbot.errors import InputError


@dataclass(frozen=True)
class GraspingSettings(Settings):
    """Measure grasping on a table top of exact shapes.

    The benchmark measures candidates per second and the time to a ranked list, including reachability by the arm. It
    varies the size of the map and the number of samples. It also measures the distance of contacts to the true
    surfaces, and the angle between the true normals and the line through the contacts.

    With runs, it samples grasps of every object of their maps instead. It compares hands and contacts with raw depth
    of more frames than the sampler used. With one-sided scans it compares fingers with true shapes.

    Examples:
        splatbot bench grasping
        splatbot bench grasping --gaussians 150000 --samples 400 3200
        splatbot bench grasping --quick --json figures.json
        splatbot bench grasping --run runs/desk runs/shelf
        splatbot bench grasping --reliability 45
        splatbot bench grasping --one-sided 60 --first 0

    Args:
        gaussians: Sizes of the maps. Samples are varied on the first.
        samples: Numbers of seeds on the surface of an object.
        run: Folders of runs with a scene.yaml.
        reliability: Number of simulated scenes in which up to five grasps each are executed, to compare confidence and
            success (half a minute a scene).
        one_sided: Number of simulated scenes that are scanned from one side (ten seconds a scene).
        first: Seed of the first of these scenes.
    """

    name: ClassVar[str] = "grasping"
    quick_values: ClassVar[Mapping[str, Any]] = {"gaussians": (10_000,), "samples": (50, 100)}

    gaussians: Annotated[tuple[int, ...], arg(metavar="N ...")] = (50_000, 10_000, 150_000)
    samples: Annotated[tuple[int, ...], arg(metavar="N ...")] = (50, 100, 200, 400, 800, 1600)
    run: Annotated[tuple[Path, ...], arg(metavar="RUN ...")] = ()
    reliability: Annotated[int, arg(metavar="SCENES")] = 0
    one_sided: Annotated[int, arg(metavar="SCENES")] = 0
    first: Annotated[int, arg(metavar="SEED")] = 400

    def validate(self) -> None:
        """Raise an InputError for numbers below 1."""
        if min(self.reliability, self.one_sided, self.first) < 0:
            raise InputError("is negative.", field="--reliability, --one-sided, --first", hint="give 0 or more")
        if not self.gaussians or min((*self.gaussians, *self.samples)) < 1:
            raise InputError("has a number below 1.", field="--gaussians, --samples", hint="give positive numbers")


def _measure(settings: GraspingSettings, report_progress: ReportProgress) -> Results:
    if settings.reliability:
        from splatbot.bench.grasping.reliability import run_reliability

        return run_reliability(settings, report_progress)
    if settings.one_sided:
        from splatbot.bench.grasping.one_sided import run_one_sided

        return run_one_sided(settings, report_progress)
    if settings.run:
        from splatbot.bench.grasping.recorded import run_recorded

        return run_recorded(settings, report_progress)
    from splatbot.bench.grasping.accuracy import run_grasping

    return run_grasping(settings, report_progress)


def _plot(results: Results, folder: Path) -> None:
    if any(row.case == "all grasps" for row in results.rows):
        from splatbot.bench.grasping.reliability import plot_reliability

        plot_reliability(results, folder)


BENCHMARK = Benchmark(
    GraspingSettings,
    _measure,
    plot=_plot,
    tables=(
        Table("By size of the map", lambda row: "Gaussians" in row.case, layout=per_metric),
        Table("By samples", lambda row: "samples" in row.case, layout=per_metric),
        Table("Reliability", lambda row: "confidence" in row.case or "all " in row.case or "fit" in row.case),
        Table("Scans from one side", lambda row: "one side" in row.case, layout=per_metric),
        Table("Maps of recordings", lambda row: "/" in row.case and "side" not in row.case, layout=per_metric),
    ),
)
