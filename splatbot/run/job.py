"""map_log: a whole log through SLAM, saved, scored and reported."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from splatbot.calibration.timing import SensorTiming, with_estimated_timing, without_timing
from splatbot.config import Config, with_cameras, with_sensor
from splatbot.errors import InputError, LogError
from splatbot.logs import Log
from splatbot.logs.base import LogPart, frames_from
from splatbot.logs.live import RecordedCamera
from splatbot.results.folder import RunFolder
from splatbot.results.metrics import cost_metrics
from splatbot.results.scoring import score_trajectory
from splatbot.run.interrupts import Interrupts
from splatbot.run.loop import FrameLoop
from splatbot.run.outcome import MapPage, RunOutcome
from splatbot.run.pacing import CameraFrames, LogFrames, PacedSource
from splatbot.run.progress import Progress
from splatbot.run.saving import Saver, first_frame_of, resume_loop
from splatbot.run.state import Checkpoint, SavedRun
from splatbot.slam import Slam


@dataclass(frozen=True)
class RunResult:
    """A finished run: its folder, its ``metrics.json``, and the error or signal that ended it early, if any."""

    folder: Path
    metrics: dict[str, Any]
    error: InputError | None = None
    signal: int | None = None

    @property
    def exit_code(self) -> int:
        """0; or the error's, or 128 + signal as shells have it (130 for Ctrl-C)."""
        if self.error is not None:
            return self.error.exit_code
        return 128 + self.signal if self.signal is not None else 0


def map_log(
    log: Log,
    *,
    out: str | Path,
    config: Config | None = None,
    slam: Slam | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    on_bad_frame: Literal["stop", "skip"] = "stop",
    max_frames: int | None = None,
    first_frame: int = 0,
    realtime: bool = False,
    rate: float | None = None,
    save_every: float | None = None,
    resume: SavedRun | None = None,
    localise: SavedRun | None = None,
    source: dict[str, Any] | None = None,
    effects: Sequence[Mapping[str, Any]] | None = None,
    map_page: MapPage | None = None,
    report: bool = True,
) -> RunResult:
    """Map a log, or a camera until it ends, and write the run folder ``out``.

    Every ``config.mapping.holdout_every``-th frame is tracked but kept out of the map, and the finished map is scored
    against it. Ctrl-C, SIGTERM and an unreadable frame end the mapping early. The map up to there is saved,
    scored and reported like a complete run. A second Ctrl-C skips scoring and report.

    Args:
        log: the recording, or a camera (:class:`splatbot.logs.live.RecordedCamera`). Ctrl-C is the normal end of a
            camera; its frames come in real time.
        out: folder to write; files of an earlier run there are replaced once there is something to replace them with.
        config: configuration. If None, that of ``slam`` or the defaults apply.
        slam: the SLAM to run, without frames yet. If None, one is made from ``config``.
        on_progress: called after every frame and at every phase.
        on_bad_frame: whether a frame that cannot be read ends the mapping or is skipped.
        max_frames: read no more frames than this.
        first_frame: index of the first frame to read. A resumed run keeps its own.
        localise: run whose map the frames are localized in. The map does not change, the trajectory is in its world
            frame, and its configuration applies.
        realtime: deliver frames at the times of their stamps, as a camera does, and map in a second thread. Frames that
            arrive while an earlier one is processed are dropped; dropped and late frames are counted.
        rate: deliver frames at this rate [Hz] instead of that of their stamps; implies ``realtime``.
        save_every: interval [s] at which the whole state is saved into ``out/state``; it is also saved at the end. A
            run that is killed loses the frames after the last save. If None, the state is not saved.
        resume: saved run to continue. ``log`` must be its log; ``config`` and ``slam`` are those of the run.
        source: further arguments needed to open the log again; ``metrics.json`` keeps them under "log".
        effects: description of the sensor effects that the log's frames went through. If None, that of the log.
        map_page: makes a page of the finished map for the report. If None, the report has no such page.
        report: audit the map against measured depth and write the report, which takes seconds.

    Raises:
        LogError: The log is empty, no frame could be read, or it is not the log of ``resume``; no file is written.
        InputError: ``out`` cannot be written.
        KeyboardInterrupt: A signal arrived before the first frame was mapped.
    """
    if resume is not None:
        resume.place.check(log)
        config, slam = resume.config, resume.slam
    tell = on_progress or (lambda _: None)

    def report_step(step: Progress) -> None:
        tell(replace(step, done=max(step.done - first_frame, 0), total=max(step.total - first_frame, 0)))

    timing = _estimated_timing(resume)

    def calibrated(config: Config) -> tuple[Config, SensorTiming | None]:
        config = with_sensor(config, log.calibration.sensor, file=log.calibration.file)
        if isinstance(log, RecordedCamera):
            return config, None
        part = LogPart(log, first_frame, max_frames)
        step = Progress("calibrating", 0, len(part), 0.0)
        return with_estimated_timing(config, part, len(part), report_progress=lambda _: tell(step))

    if localise is not None:
        slam = localise.slam
        config = with_cameras(localise.config.model_copy(update={"cameras": {}}), log.cameras, file=log.uri)
        if _estimated_timing(localise) is not None:  # of the recording that was mapped
            config, timing = calibrated(without_timing(config))
        slam.localise_only(config)
    config = config or (slam.config if slam else Config())
    if slam is None:
        if log.cameras and config.cameras:
            hint = "leave `cameras` out of the configuration, or give the recording of one camera"
            raise InputError("describes its cameras itself.", file=log.uri, field="cameras", hint=hint)
        config = with_cameras(config, log.cameras, file=log.uri)
    if not log.cameras.keys() <= config.cameras.keys():
        hint = "restore the file of the cameras, or map the log again"
        raise InputError("lists other cameras than the run.", file=log.uri, field="cameras", hint=hint)
    realtime = realtime or rate is not None or isinstance(log, RecordedCamera)
    if rate is not None and not 0 < rate < 1e4:
        raise InputError(f"is {rate}.", field="rate", hint="give frames per second, above 0")
    if realtime and slam is None:
        threaded = config.mapping.model_copy(update={"threaded": True})
        wall_clock = config.tracking.model_copy(update={"deterministic": False})
        config = config.model_copy(update={"mapping": threaded, "tracking": wall_clock})
    begin = first_frame if resume is None else first_frame_of(resume)
    frames = _frames(log, begin, max_frames, realtime, rate)
    if slam is None:
        config, timing = calibrated(config)
    folder = RunFolder.create(out)
    truth = log.ground_truth  # read now: a damaged file must not cost the user a whole run
    loop = FrameLoop(frames, slam or Slam(config), config, on_bad_frame, report_step, begin=begin)
    if resume is not None:
        resume_loop(loop, resume)
    with Interrupts() as interrupts:

        def outcome() -> RunOutcome:
            return RunOutcome(
                loop=loop,
                timing=timing,
                source=source or {},
                map_page=map_page,
                report=report,
                localised_in=str(localise.folder.resolve()) if localise is not None else None,
                effects=list(log.effects if effects is None else effects),
                interrupts=interrupts,
                model=loop.slam.snapshot().model,
                rows=loop.rows(),
                costs=cost_metrics(loop.rows()),
                trajectories={name: loop.slam.trajectory_of(name) for name in ("", *config.cameras)},
                track=score_trajectory(loop.slam.trajectory, truth, loop.covariances()),
            )

        if save_every is not None and localise is None:
            checkpoint = Checkpoint(folder.path, save_every)
            opened = source or {}
            loop.saver = Saver(
                checkpoint,
                log,
                opened.get("camera"),
                lambda: outcome().save_files(folder),
                robot=opened.get("robot"),
            )
        loop.run(interrupts)
        if not loop.slam.results:
            folder.remove_if_new()
            raise loop.crash or loop.error or loop.first_bad or KeyboardInterrupt()
        ended = outcome()
        ended.finished = True
        ended.save(folder)
    if loop.crash is not None:
        raise loop.crash
    return RunResult(folder.path, ended.metrics(), error=loop.error, signal=interrupts.requested)


def _estimated_timing(run: SavedRun | None) -> SensorTiming | None:
    """Return the times of the sensor that an earlier run estimated."""
    folder = None if run is None else RunFolder(run.folder)
    if folder is None or not folder.metrics.is_file():
        return None
    return SensorTiming.of_metrics(folder.load_metrics().get("sensor_timing"))


def _frames(log: Log, begin: int, max_frames: int | None, realtime: bool, rate: float | None) -> LogFrames:
    """Return the source of the frames.

    Raises:
        LogError: the log is empty.
        InputError: the log has no frame ``begin``.
    """
    if isinstance(log, RecordedCamera):
        return CameraFrames(log)
    if len(log) == 0:
        raise LogError("has no frames.", file=log.name, hint="record the log again, or name another one")
    total = frames_from(log, begin, max_frames).stop
    source = PacedSource(log, total, rate) if realtime else LogFrames(log, total)
    source.first = begin
    return source
