"""Error over time of tracking on logs, for each time budget and for other trackers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.timing import memory_peak
from splatbot.bench.tracking import (
    ATE,
    FRAME_MS,
    JUMPS,
    LOST,
    NEES,
    NEES_AS_GIVEN,
    PERCENTILES,
    RESIDENT,
    RPE,
    RPE_ROT,
    TRACKED,
    TrackingSettings,
)
from splatbot.bench.tracking.peers import Odometry, tracking_peers
from splatbot.bench.tracking.stress import run_stress
from splatbot.calibration.timing import with_estimated_timing
from splatbot.config import Config, load_config, with_sensor
from splatbot.evaluation import relative_error
from splatbot.frame import Frame
from splatbot.logs import Log, open_log
from splatbot.protocols import Array
from splatbot.results.scoring import score_trajectory, trajectory_metrics
from splatbot.slam import Slam
from splatbot.trajectory import Trajectory

# Changes of an ablation: name, section, key and value of the setting.
ABLATIONS = (
    ("without bundle adjustment", "bundle", "enabled", False),
    ("with replaced keyframes", "mapping", "replace_poor", True),
)


@dataclass(frozen=True)
class Contender:
    """One row of the comparison: a tracker, its name, a setting and a note. If the name is None, it is splatbot."""

    peer: str | None
    setting: str
    note: str
    make: Callable[[], Odometry]


@dataclass
class TrackingOutcome:
    """Result of a tracker on a log: times by frame [ms], estimated poses, covariances, and memory.

    Covariances (N, 6, 6) of the trajectory's poses as of :func:`splatbot.evaluation.nees`; None of a tracker without.
    """

    ms: list[float]
    trajectory: Trajectory
    frames: int
    resident: int | None
    with_mapping_ms: list[float]
    covariances: Array | None
    accepted: NDArray[np.bool_] | None = None
    """(N,) whether the verdict of each pose is "ok"; None of a tracker without verdicts."""


class SlamOdometry:
    """splatbot as a tracker, with separate times of tracking and mapping."""

    def __init__(self, config: Config) -> None:
        self.slam = Slam(config)

    def track(self, frame: Frame) -> Array | None:
        """Track a frame; see :class:`Odometry`."""
        return self.slam.process(frame).T_world_camera

    @property
    def last_tracking_ms(self) -> float:
        """Milliseconds that the last frame's pose took, mapping left out."""
        return sum(ms for stage, ms in self.slam.results[-1].stage_ms.items() if stage != "mapping")

    def refined(self) -> Trajectory:
        """Return the trajectory after the end of the log."""
        found = [(r.stamp, r.T_world_camera) for r in self.slam.results if r.T_world_camera is not None]
        return _trajectory([stamp for stamp, _ in found], [T for _, T in found])

    def covariances(self) -> Array | None:
        """Return the covariances (N, 6, 6) of these poses. If None, at least one is unknown."""
        found = [r.covariance for r in self.slam.results if r.T_world_camera is not None]
        known = [covariance for covariance in found if covariance is not None]
        return np.array(known) if len(known) == len(found) > 0 else None

    def accepted(self) -> NDArray[np.bool_]:
        """Return (N,) whether the verdict of each of these poses is "ok"."""
        return np.array([r.verdict == "ok" for r in self.slam.results if r.T_world_camera is not None])


def run_tracking(settings: TrackingSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Run every contender on every log, and score it."""
    config = load_config(settings.config)
    logs = [open_log(address, camera=settings.camera) for address in settings.addresses]
    results = Results(describe_machine((1,), peak_ms=20))
    for name, log in zip(distinct([log.name for log in logs]), logs, strict=True):
        calibrated = with_sensor(config, log.calibration.sensor, file=log.calibration.file)
        report_progress(f"{name}: sensor")
        calibrated, _ = with_estimated_timing(calibrated, log, settings.max_frames or len(log))
        for contender in contenders(settings, calibrated):
            report_progress(f"{name}: {contender.peer or 'splatbot'} {contender.setting}".rstrip())
            add_rows(results, log, contender, run_log(log, contender.make(), settings.max_frames), name)
    if settings.stress:
        frames, width = settings.stress_frames, settings.stress_width
        run_stress(results, config, frames=frames, width=width, report_progress=report_progress)
    return results


def distinct(names: Sequence[str]) -> list[str]:
    """Append a number to repeated names: room, room #2."""
    return [name if (n := names[: k + 1].count(name)) == 1 else f"{name} #{n}" for k, name in enumerate(names)]


def contenders(settings: TrackingSettings, config: Config) -> Iterator[Contender]:
    """Yield splatbot with each budget, then the changes of an ablation if requested, then its peers."""
    for budget in settings.budgets:
        limited = _with_budget(config, budget)
        yield Contender(None, f"{budget:g} ms", "", lambda limited=limited: SlamOdometry(limited))  # type: ignore[misc]
    for change, section, key, value in ABLATIONS if settings.ablation else ():
        changed = _with_value(_with_budget(config, settings.budgets[0]), section, key, value)
        name = f"{settings.budgets[0]:g} ms {change}"
        yield Contender(None, name, "", lambda changed=changed: SlamOdometry(changed))  # type: ignore[misc]
    for peer in tracking_peers() if not settings.no_peers else ():
        yield Contender(peer.name, "", peer.note, peer.make)


def run_log(log: Log, odometry: Odometry, max_frames: int | None = None) -> TrackingOutcome:
    """Track the frames of a log; decoding is not timed."""
    count = len(log) if max_frames is None else min(len(log), max_frames)
    ms, whole, stamps, poses = [], [], [], []
    with memory_peak() as peak:
        for index in range(count):
            frame = log[index]
            start = time.perf_counter()
            T_world_camera = odometry.track(frame)
            whole.append(1e3 * (time.perf_counter() - start))
            ms.append(odometry.last_tracking_ms if isinstance(odometry, SlamOdometry) else whole[-1])
            if T_world_camera is not None:
                stamps.append(frame.stamp)
                poses.append(T_world_camera)
    if isinstance(odometry, SlamOdometry):
        return TrackingOutcome(
            ms, odometry.refined(), count, peak(), whole, odometry.covariances(), odometry.accepted()
        )
    return TrackingOutcome(ms, _trajectory(stamps, poses), count, peak(), whole, None)


def add_rows(results: Results, log: Log, contender: Contender, outcome: TrackingOutcome, name: str) -> None:
    """Add the rows of one run. ATE is RMSE over all tracked frames, SE(3)-aligned; RPE from frame to frame."""
    case = f"{name}, {contender.setting}" if contender.setting else name

    def add(metric: str, value: float | None, unit: str, note: str | None = None) -> None:
        results.add(case, metric, value, unit, peer=contender.peer, note=note or None)

    truth, tracked = log.ground_truth, outcome.trajectory
    if truth is None or len(tracked) < 3:
        why = "no reference" if truth is None else "tracked fewer than three frames"
        for metric in (ATE, RPE, RPE_ROT):
            add(metric, None, "mm", why)
    else:
        score = trajectory_metrics(score_trajectory(tracked, truth, outcome.covariances))
        ate, rpe = score["ate_rmse_m"], score["rpe_trans_rmse_m"]
        add(ATE, None if ate is None else 1e3 * ate, "mm", contender.note if ate is not None else "no stamp matches")
        add(RPE, None if rpe is None else 1e3 * rpe, "mm")
        add(RPE_ROT, score["rpe_rot_rmse_deg"], "°")
        if outcome.covariances is not None:
            add(NEES, score["nees"], "", "fewer than ten frames" if score["nees"] is None else None)
            add(NEES_AS_GIVEN, score["nees_as_given"], "")
        if outcome.covariances is not None and outcome.accepted is not None:
            add(JUMPS, 100.0 * jumps_reported_ok(truth, tracked, outcome.covariances, outcome.accepted), "%")
    add(TRACKED, 100.0 * len(tracked) / outcome.frames, "%")
    add(LOST, outcome.frames - len(tracked), "")
    for p in PERCENTILES:
        add(f"p{p}", float(np.percentile(outcome.ms, p)), "ms")
    if contender.peer is None:
        add(FRAME_MS, float(np.median(outcome.with_mapping_ms)), "ms")
    add(RESIDENT, None if outcome.resident is None else outcome.resident / 1e6, "MB")


def jumps_reported_ok(truth: Trajectory, tracked: Trajectory, covariances: Array, accepted: NDArray[np.bool_]) -> float:
    """Compute the share of frames reported as ok whose motion since the last frame is wrong by more than three sigma.

    Sigma is √(trace of the translation's covariance), of the one of the two frames where it is larger.

    Args:
        truth: reference poses.
        tracked: N estimated poses.
        covariances: (N, 6, 6) of the estimate, by which a pose is uncertain.
        accepted: (N,) whether the verdict of a pose is "ok".
    """
    relative = relative_error(truth, tracked)
    rows = np.searchsorted(tracked.stamps, relative.stamps)
    sigma = np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2))
    jumps = relative.trans > 3 * np.maximum(sigma[rows], sigma[rows - 1])
    return float(np.mean(jumps & accepted[rows]))


def _with_budget(config: Config, budget_ms: float) -> Config:
    return _with_value(config, "tracking", "budget_ms", budget_ms)


def _with_value(config: Config, section: str, key: str, value: float | bool) -> Config:
    values = config.model_dump(mode="json")  # null marks a value that depends on the budget
    values[section][key] = value
    return Config.model_validate(values)


def _trajectory(stamps: Sequence[float], poses: Sequence[Array]) -> Trajectory:
    return Trajectory(np.array(stamps), np.array(poses, dtype=np.float64).reshape(-1, 4, 4))
