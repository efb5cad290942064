"""`splatbot bench raster`: the speed of the rasterizer, compared with other implementations and with the machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import Suppress, arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table, cases, notes_of_peers, per_row
from splatbot.errors import InputError

EFFECT, SWEEP, GROWTH = "effect", "sweep", "growth"


@dataclass(frozen=True)
class RasterSettings(Settings):
    """Measure the speed of the rasterizer, and how its error depends on the time.

    Built-in scenes are rendered from 320x240 to 1280x720, forward and backward, through Python and autograd. The
    benchmark also measures the share of this machine's peak of multiply-adds, the fused loss and the cost of each
    option. It varies settings for the error over the time, and sizes for the growth. Times are the least of several
    runs [ms], with the median.

    Examples:
        splatbot bench raster
        splatbot bench raster --peers
        splatbot bench raster --splat runs/latest/map.ply --threads 1 2 4
        splatbot bench raster --variants
        splatbot bench raster --quick --json figures.json

    Args:
        peers: Also measure other implementations of the same model, at the first size (minutes).
        splat: Map or splat file to render in addition to the built-in scenes.
        threads: Numbers of threads of the kernels.
        variants: Also compile the C++ core with other constants (exponential, tiles) and measure it (ten minutes).
        sizes: Width and height of the images [px].
        runs: Largest number of repetitions of a measurement.
        budget_s: Time [s] after which a measurement is not repeated.
    """

    name: ClassVar[str] = "raster"
    quick_values: ClassVar[Mapping[str, Any]] = {"sizes": ((32, 24),), "runs": 2, "budget_s": 0.1}

    peers: bool = False
    splat: Annotated[Path | None, arg(metavar="FILE")] = None
    threads: Annotated[tuple[int, ...], arg(metavar="N ...")] = (1, 2)
    variants: bool = False
    sizes: Suppress[tuple[tuple[int, int], ...]] = ((320, 240), (640, 480), (1280, 720))
    runs: Suppress[int] = 25
    budget_s: Suppress[float] = 1.0

    def validate(self) -> None:
        """Raise an InputError for a number of threads below 1."""
        if not self.threads or min(self.threads) < 1:
            raise InputError(f"is {self.threads}.", field="--threads", hint="give positive numbers, as in 1 2")


def _measure(settings: RasterSettings, report_progress: ReportProgress) -> Results:
    from splatbot.bench.raster.speed import run_raster

    return run_raster(settings, report_progress)


def _plot(results: Results, folder: Path) -> None:
    from splatbot.bench.raster.plots import plot_growth, plot_sweeps

    plot_sweeps(results, folder)
    plot_growth(results, folder)


_TIMES = ("forward", "forward+backward", "forward+pose backward")
_SHARES = ("blend forward, share of FMA peak", "blend backward, share of FMA peak")
_GROWTH = ("forward+backward", "stages over Gaussians", "stages over pixels", "pairs per pixel")

BENCHMARK = Benchmark(
    RasterSettings,
    _measure,
    tables=(
        Table(
            "Time [ms], least (median)",
            lambda row: row.peer is None and not row.case.startswith((EFFECT, SWEEP, GROWTH)),
            (*_TIMES, "state memory", "peak memory", *_SHARES),
        ),
        Table(
            "Cost of each option [ms]",
            cases(EFFECT),
            (
                *("forward, off", "forward+backward, off"),
                *("forward, on minus off", "forward+backward, on minus off"),
            ),
        ),
        Table("Error over time", cases(SWEEP), ("forward", "largest error", "PSNR")),
        Table("Growth", cases(GROWTH), (*_GROWTH, "one Gaussian", "one evaluated pair")),
        Table("Growth relative to linear", lambda row: row.case.startswith(GROWTH) and row.unit == "x", layout=per_row),
        Table(
            "Peers, in the same process",
            lambda row: row.peer is not None,
            (
                *_TIMES[:2],
                *("forward, ratio to splatbot", "forward+backward, ratio to splatbot"),
                *("image, error of 99.9 % of the pixels", "gradients, largest relative difference"),
            ),
        ),
        Table("", lambda row: row.metric == "implementation", layout=notes_of_peers),
    ),
    plot=_plot,
)
