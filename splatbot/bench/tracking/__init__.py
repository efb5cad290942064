"""`splatbot bench tracking`: error over time of tracking, for each time budget and for other trackers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import Positional, Suppress, arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table, cases
from splatbot.errors import InputError

ATE, RPE, RPE_ROT, NEES, TRACKED, LOST = "ATE", "RPE", "RPE, rotation", "NEES / 6", "tracked", "lost"
NEES_AS_GIVEN = "NEES / 6, as given"
JUMPS = "jumps reported as ok"
PERCENTILES, RESIDENT = (50, 95, 99), "peak resident memory"
FRAME_MS = "tracking and mapping p50"

STRESS = "stress"
SILENT, WORST, DEGRADED = "wrong frames reported as ok", "largest error of an ok frame", "degraded"
RECOVERY, AFTER, VIEWS = "time to recovery", "largest error after recovery", "PSNR loss of views"

_QUICK_LOG = "synthetic:tabletop?width=160&height=120&frames=6"


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """Measure the error of tracking over its time, and compare it with other trackers.

    Each log is tracked with each time budget, and by other trackers in the same process. These are RGB-D odometry of
    OpenCV and of Open3D, small_gicp, and ORB with PnP against keyframes. Errors are the ATE (RMSE over all tracked
    frames after rigid alignment) and the RPE. Times end when the pose is known; decoding and mapping do not count.
    NEES / 6 is 1 for consistent covariances. It includes the error of the reference. The pose of the
    camera on the body that the reference follows is fitted, but not in "as given".

    --ablation also runs splatbot without bundle adjustment, and with replaced keyframes, with the first budget.
    "Jumps reported as ok" counts frames with the verdict "ok" whose motion since the last frame is wrong by more than
    three sigma.

    --stress runs hard synthetic logs with exact ground truth: flat walls, a corridor, pure rotation, jumps, depth
    holes, black frames, exposure, a hand. Each frame is within a bound or reported as degraded or lost.

    Examples:
        splatbot bench tracking recordings/desk
        splatbot bench tracking recordings/desk recordings/shelf --no-peers
        splatbot bench tracking --stress
        splatbot bench tracking "synthetic:room?trajectory=loop&frames=90" --budgets 30 100 --json figures.json
        splatbot bench tracking --quick

    Args:
        logs: Recordings with a reference trajectory, as for splatbot map. Logs of the same name are numbered.
        budgets: Time budgets per frame [ms].
        no_peers: Leave out the other trackers.
        max_frames: Read only the first N frames of each log.
        ablation: Also run without bundle adjustment, and with better views that replace poor keyframes.
        stress: Run the hard synthetic logs. LOG and --budgets are not needed.
        config: YAML file with settings that all runs share.
        camera: Intrinsics that replace those of the logs: tum_fr1, tum_fr2, tum_fr3 or an intrinsics.json.
        stress_frames: Frames of a hard log.
        stress_width: Width of its images [px].
    """

    name: ClassVar[str] = "tracking"
    quick_values: ClassVar[Mapping[str, Any]] = {"budgets": (30.0,), "stress_frames": 12, "stress_width": 160}

    logs: Annotated[tuple[str, ...], Positional, arg(metavar="LOG ...")] = ()
    budgets: Annotated[tuple[float, ...], arg(metavar="MS ...")] = (30.0, 100.0, 300.0, 1000.0)
    no_peers: bool = False
    max_frames: Annotated[int | None, arg(metavar="N")] = None
    ablation: bool = False
    stress: bool = False
    config: Annotated[Path | None, arg(metavar="FILE")] = None
    camera: Annotated[str | None, arg(metavar="PRESET|FILE")] = None
    stress_frames: Suppress[int] = 90
    stress_width: Suppress[int] = 640

    def validate(self) -> None:
        """Raise an InputError for a missing log, fewer than three frames, or a budget that is not positive."""
        if not self.addresses and not self.stress:
            raise InputError("is missing.", field="LOG", hint="name recordings: splatbot bench tracking LOG ...")
        if self.max_frames is not None and self.max_frames < 3:
            raise InputError(f"is {self.max_frames}.", field="--max-frames", hint="give at least 3")
        if not self.budgets or min(self.budgets) <= 0:
            raise InputError(f"is {self.budgets}.", field="--budgets", hint="give milliseconds, as in 30 100")

    @property
    def addresses(self) -> tuple[str, ...]:
        """Logs to track; with ``quick`` and without any, a short synthetic one."""
        return self.logs or ((_QUICK_LOG,) if self.quick and not self.stress else ())


def _measure(settings: TrackingSettings, report_progress: ReportProgress) -> Results:
    from splatbot.bench.tracking.accuracy import run_tracking

    return run_tracking(settings, report_progress)


def _plot(results: Results, folder: Path) -> None:
    from splatbot.bench.tracking.plots import plot_tracking

    plot_tracking(results, folder)


BENCHMARK = Benchmark(
    TrackingSettings,
    _measure,
    tables=(
        Table(
            "Tracking",
            lambda row: not row.case.startswith(STRESS),
            (
                ATE,
                RPE,
                RPE_ROT,
                NEES,
                NEES_AS_GIVEN,
                JUMPS,
                TRACKED,
                LOST,
                *(f"p{p}" for p in PERCENTILES),
                FRAME_MS,
                RESIDENT,
            ),
        ),
        Table("Hard logs", cases(STRESS), ("bound", SILENT, WORST, DEGRADED, LOST, RECOVERY, AFTER, VIEWS)),
    ),
    plot=_plot,
)
