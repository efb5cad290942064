"""The frames of a log, one after the other, and what is done with the map when they are through."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splatbot import __version__
from splatbot.config import Config
from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.logs import Log
from splatbot.report import report_html
from splatbot.results.folder import FrameRow, RunFolder
from splatbot.results.metrics import cost_metrics, without_nan
from splatbot.results.scoring import TrajectoryScore, ViewScores, score_trajectory, score_views, trajectory_metrics
from splatbot.run.interrupts import Interrupts
from splatbot.slam import FrameResult, Slam
from splatbot.trajectory import Trajectory

Phase = Literal["mapping", "refining", "saving", "scoring", "reporting"]


@dataclass(frozen=True)
class Progress:
    """Where a run stands.

    Args:
        phase: what is being done.
        done: frames read so far, of ``total``.
        total: frames to read.
        elapsed_s: time since the first frame [s].
        result: what became of the latest frame; None when it could not be read, or after the last.
        skipped: why the latest frame could not be read, "" otherwise.
        keyframes: frames that entered the map so far.
        lost: frames lost so far.
        gaussians: size of the map.
    """

    phase: Phase
    done: int
    total: int
    elapsed_s: float
    result: FrameResult | None = None
    skipped: str = ""
    keyframes: int = 0
    lost: int = 0
    gaussians: int = 0


@dataclass(frozen=True)
class RunResult:
    """A finished run: where it lies, its ``metrics.json``, and what ended it early, if anything did."""

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
    source: dict[str, Any] | None = None,
) -> RunResult:
    """Map a log and write the run folder ``out``.

    Every ``config.mapping.holdout_every``-th frame is tracked but kept out of the map, and the finished map is scored
    against it. Ctrl-C, SIGTERM and an unreadable frame end the mapping early; what was mapped until then is saved,
    scored and reported like a whole run. A second Ctrl-C gives up scoring and report.

    Args:
        log: the recording.
        out: folder to write; files of an earlier run there are replaced once there is something to replace them with.
        config: None for the defaults.
        slam: the SLAM to run, fresh; None makes one from ``config``.
        on_progress: called after every frame and at every phase.
        on_bad_frame: what to do about a frame that cannot be read.
        max_frames: read no more frames than this.
        source: how to open the log again, kept in ``metrics.json`` under "log".

    Raises:
        LogError: the log is empty, or no frame could be read; nothing is written then.
        InputError: ``out`` cannot be written.
        KeyboardInterrupt: interrupted before the first frame was mapped.
    """
    config = config or Config()
    folder = RunFolder.create(out)
    total = len(log) if max_frames is None else min(len(log), max_frames)
    if total == 0:
        raise LogError("has no frames.", file=log.name, hint="record the log again, or name another one")
    truth = log.ground_truth  # now: a damaged file must not cost the user a whole run
    mapping = _Mapping(log, slam or Slam(config), config, total, on_bad_frame, on_progress or (lambda _: None))
    with Interrupts() as interrupts:
        crash = mapping.run(interrupts)
        if not mapping.slam.results:
            raise crash or mapping.error or mapping.first_bad or KeyboardInterrupt()
        outcome = _Outcome(
            mapping=mapping,
            source=source or {},
            interrupts=interrupts,
            model=mapping.slam.snapshot().model,
            rows=mapping.rows(),
            costs=cost_metrics(mapping.rows()),
            trajectory=mapping.trajectory(),
            track=score_trajectory(mapping.trajectory(), truth),
        )
        outcome.save(folder)
    if crash is not None:
        raise crash
    return RunResult(folder.path, outcome.metrics(), error=mapping.error, signal=interrupts.requested)


@dataclass
class _Mapping:
    """The loop over the frames."""

    log: Log
    slam: Slam
    config: Config
    total: int
    on_bad_frame: str
    tell: Callable[[Progress], None]
    ms: dict[int, float] = field(default_factory=dict)
    held_out: set[int] = field(default_factory=set)
    skipped: dict[int, str] = field(default_factory=dict)
    keyframes: int = 0
    lost: int = 0
    error: InputError | None = None
    first_bad: InputError | None = None
    started: float = field(default_factory=time.perf_counter)

    def run(self, interrupts: Interrupts) -> Exception | None:
        """Process the frames; returns what broke unexpectedly, to be raised when the map is saved."""
        try:
            for index in range(self.total):
                if interrupts.requested is not None or not self._step(index):
                    return None
            self.progress("refining")
            self.slam.finish()
        except KeyboardInterrupt:  # the second signal, or one raised by a callback
            interrupts.requested = interrupts.requested or 2
        except Exception as crash:
            return crash
        return None

    def _step(self, index: int) -> bool:
        """Read and process one frame; False when the log ends here."""
        try:
            frame = self.log[index]
        except InputError as error:
            self.first_bad = self.first_bad or error
            if self.on_bad_frame == "stop":
                self.error = error
                return False
            self.skipped[index] = str(error)
            self.progress("mapping", done=index + 1, skipped=str(error))
            return True
        result = self._process(frame, index)
        self.keyframes += result.keyframe
        self.lost += result.verdict == "lost"
        self.progress("mapping", done=index + 1, result=result)
        return True

    def _process(self, frame: Frame, index: int) -> FrameResult:
        every = self.config.mapping.holdout_every
        hold_out = every > 0 and index % every == every - 1
        if hold_out:
            self.held_out.add(index)
        start = time.perf_counter()
        result = self.slam.process(frame, hold_out=hold_out)
        self.ms[index] = 1e3 * (time.perf_counter() - start)
        return result

    def progress(
        self, phase: Phase, *, done: int | None = None, result: FrameResult | None = None, skipped: str = ""
    ) -> None:
        """Tell the caller where the run stands."""
        results = self.slam.results
        self.tell(
            Progress(
                phase=phase,
                done=self.done if done is None else done,
                total=self.total,
                elapsed_s=time.perf_counter() - self.started,
                result=result,
                skipped=skipped,
                keyframes=self.keyframes,
                lost=self.lost,
                gaussians=results[-1].gaussians if results else 0,
            )
        )

    @property
    def done(self) -> int:
        """Frames read, or tried."""
        return len(self.ms) + len(self.skipped)

    def rows(self) -> list[FrameRow]:
        """One row per frame, in the log's order."""
        rows = [
            FrameRow(
                index=r.index,
                stamp=r.stamp,
                verdict=r.verdict,
                reasons=tuple(r.reasons),
                stage=r.stage,
                ms=self.ms.get(r.index, 0.0),
                stage_ms={name: float(ms) for name, ms in r.stage_ms.items()},
                keyframe=bool(r.keyframe),
                held_out=r.index in self.held_out,
                gaussians=int(r.gaussians),
            )
            for r in self.slam.results
        ]
        rows += [FrameRow(index=i, stamp=None, verdict="skipped", reasons=(why,)) for i, why in self.skipped.items()]
        return sorted(rows, key=lambda row: row.index)

    def trajectory(self) -> Trajectory:
        """The tracked poses."""
        poses = [(r.stamp, r.T_world_camera) for r in self.slam.results if r.T_world_camera is not None]
        stamps = np.array([stamp for stamp, _ in poses], dtype=np.float64)
        return Trajectory(stamps, np.array([T for _, T in poses], dtype=np.float64).reshape(-1, 4, 4))


@dataclass
class _Outcome:
    """All that is known of a run once its frames are through."""

    mapping: _Mapping
    source: dict[str, Any]
    interrupts: Interrupts
    model: GaussianModel
    rows: list[FrameRow]
    costs: dict[str, Any]
    trajectory: Trajectory
    track: TrajectoryScore | None
    views: ViewScores = field(default_factory=ViewScores)

    def save(self, folder: RunFolder) -> None:
        """Save first; then score and report, which a signal may cut short without loss."""
        self.mapping.progress("saving")
        with self.interrupts.held():
            folder.save(
                config=self.mapping.config,
                rows=self.rows,
                trajectory=self.trajectory,
                model=self.model,
                metrics=self.metrics(),
            )
        self.interrupts.release()
        try:
            self._score_and_report(folder)
        except KeyboardInterrupt:
            folder.save_metrics(self.metrics())

    def _score_and_report(self, folder: RunFolder) -> None:
        self.mapping.progress("scoring")
        poses = {r.index: r.T_world_camera for r in self.mapping.slam.results if r.T_world_camera is not None}
        held_out = {i: poses[i] for i in sorted(self.mapping.held_out) if i in poses}
        self.views = score_views(self.mapping.log, self.model, held_out)
        folder.save_metrics(self.metrics())
        self.mapping.progress("reporting")
        folder.save_report(
            report_html(
                rows=self.rows,
                metrics=self.metrics(),
                config=self.mapping.config,
                trajectory=self.trajectory,
                track=self.track,
                views=self.views,
            )
        )

    def metrics(self) -> dict[str, Any]:
        """The contents of ``metrics.json``."""
        log, error = self.mapping.log, self.mapping.error
        values = {
            **self.costs,
            **trajectory_metrics(self.track),
            **self.views.metrics(),
            "gaussians": len(self.model),
            "map_bytes": self.model.nbytes,
            "effects": [],
            "interrupted": self.interrupts.requested is not None,
            "error": str(error) if error else None,
            "log": {"name": log.name, "frames": len(log), **self.source},
            "splatbot": __version__,
        }
        return without_nan(values)
