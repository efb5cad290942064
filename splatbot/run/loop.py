"""The loop over the frames of a log."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.results.folder import FrameRow
from splatbot.run.interrupts import Interrupts
from splatbot.run.pacing import Arrival, LogFrames
from splatbot.run.progress import Phase, Progress
from splatbot.slam import FrameResult, Slam

_DROPPED = "a newer frame had arrived"


class FrameSaver(Protocol):
    """Saves the loop while it runs; ``cost`` holds the number of saves and their duration."""

    @property
    def cost(self) -> dict[str, Any]: ...

    def processed(self, loop: FrameLoop, frame: Frame, index: int) -> None: ...

    def save(self, loop: FrameLoop) -> None: ...


@dataclass
class FrameLoop:
    """The loop over the frames, and their results.

    Args:
        source: delivers the frames.
        slam, config: the SLAM to run and its configuration.
        on_bad_frame: "stop" or "skip".
        on_progress: receives the progress.
        ms: wall-clock milliseconds by frame.
        held_out: frames that the map does not use.
        skipped: reason why a frame could not be read, by frame.
        keyframes, lost: counts so far.
        seen: number of processed frames of each camera, where there are several.
        error: the unreadable frame that ended the log.
        crash: the unexpected exception that ended the loop.
        first_bad: the first unreadable frame.
        started: clock at the start [s].
        begin: index of the first frame.
        cut: the phase that a signal cut short, "mapping" or "refinement".
        saver: saves the run while it goes on.
    """

    source: LogFrames
    slam: Slam
    config: Config
    on_bad_frame: str
    on_progress: Callable[[Progress], None]
    ms: dict[int, float] = field(default_factory=dict)
    held_out: set[int] = field(default_factory=set)
    skipped: dict[int, str] = field(default_factory=dict)
    keyframes: int = 0
    lost: int = 0
    seen: dict[str, int] = field(default_factory=dict)
    error: InputError | None = None
    crash: Exception | None = None
    first_bad: InputError | None = None
    started: float = field(default_factory=time.perf_counter)
    saver: FrameSaver | None = None
    begin: int = 0
    cut: Literal["mapping", "refinement"] | None = None

    def run(self, interrupts: Interrupts) -> None:
        """Process the frames until they end or until an error, a crash or a signal; never raises."""
        through = False
        try:
            with interrupts.noted():
                through = self._all_frames(interrupts)
            if self.saver is not None:
                with interrupts.noted():
                    self.progress("saving")
                with interrupts.noted():  # before the last refinement: a resumed run goes on as if it had not ended
                    self.saver.save(self)
            if through:
                with interrupts.noted():
                    self.progress("refining")
                self.slam.finish(stop=self._stop_of_refinement(interrupts))
            else:
                self.slam.close_loops()
            if interrupts.requested is not None:
                self.cut = "refinement" if through else "mapping"
        except Exception as crash:  # a bug; it is raised again once the map is saved
            self.crash = crash
        finally:
            self.slam.close()

    def _stop_of_refinement(self, interrupts: Interrupts) -> Callable[[], bool]:
        """Return the stop condition of the refinement, which is called before each iteration and reports it."""
        steps, done = self.slam.iterations_left, count()

        def stop() -> bool:
            with interrupts.noted():
                self.progress("refining", step=min(next(done), steps), steps=steps)
            return interrupts.requested is not None

        return stop

    def _all_frames(self, interrupts: Interrupts) -> bool:
        """Process all frames; return False if a signal or an unreadable frame ended the run.

        Ctrl-C is the normal end of a camera.

        Raises:
            KeyboardInterrupt: A signal arrived during the wait for a frame, or a callback raised it.
        """
        interrupts.when_requested = self.source.end
        exhausted = False
        with closing(iter(self.source)) as arrivals:
            while interrupts.requested is None and not exhausted:
                with interrupts.interruptible(after=1):  # a camera may be silent for long
                    arrival = next(arrivals, None)
                exhausted = arrival is None
                if arrival is not None and not self._step(arrival):
                    return False
        if self.source.live and interrupts.requested is not None:  # the signal may be why there is no next frame
            return interrupts.end_of_camera()
        return exhausted

    def _step(self, arrival: Arrival) -> bool:
        """Process one frame; False when the run ends here."""
        index = arrival.index
        try:
            if isinstance(arrival.frame, InputError):
                raise arrival.frame
            result = self._process(arrival.frame, index)
        except InputError as error:  # unreadable, or of another size
            self.held_out.discard(index)
            self.first_bad = self.first_bad or error
            if self.on_bad_frame == "stop":
                self.error = error
                return False
            self.skipped[index] = str(error)
            self.progress("mapping", done=index + 1, skipped=str(error))
            return True
        self.keyframes += result.keyframe
        self.lost += result.verdict == "lost"
        if self.saver is not None:
            self.saver.processed(self, arrival.frame, index)
        self.progress("mapping", done=index + 1, result=result)
        return True

    def _process(self, frame: Frame, index: int) -> FrameResult:
        every, number = self.config.mapping.holdout_every, index
        if self.config.cameras:
            number = self.seen.get(frame.camera_name, 0)
            self.seen[frame.camera_name] = number + 1
        hold_out = every > 0 and number % every == every - 1
        if hold_out:
            self.held_out.add(index)
        start = time.perf_counter()
        result = self.slam.process(frame, hold_out=hold_out)
        self.ms[index] = 1e3 * (time.perf_counter() - start)
        return result

    def progress(
        self,
        phase: Phase,
        *,
        done: int | None = None,
        result: FrameResult | None = None,
        skipped: str = "",
        warning: str = "",
        step: int = 0,
        steps: int = 0,
    ) -> None:
        """Report the progress to the caller."""
        results = self.slam.results
        self.on_progress(
            Progress(
                phase=phase,
                done=self.done if done is None else done,
                total=self.source.total,
                elapsed_s=time.perf_counter() - self.started,
                result=result,
                skipped=skipped,
                warning=warning,
                step=step,
                steps=steps,
                keyframes=self.keyframes,
                lost=self.lost,
                late=len(self.source.late),
                dropped=len(self.source.dropped),
                gaussians=results[-1].gaussians if results else 0,
            )
        )

    @property
    def done(self) -> int:
        """Index after the last frame that was read, skipped or dropped."""
        return self.begin + len(self.ms) + len(self.skipped) + len(self.source.dropped)

    def rows(self) -> list[FrameRow]:
        """Return one row per frame, in the order of the log."""
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
                late=r.index in self.source.late,
                covariance=None if r.covariance is None else tuple(r.covariance[np.triu_indices(6)].tolist()),
                skipped=tuple(r.skipped),
                camera_name=r.camera_name,
            )
            for r in self.slam.results
        ]
        rows += [FrameRow(index=i, stamp=None, verdict="skipped", reasons=(why,)) for i, why in self.skipped.items()]
        rows += [FrameRow(index=i, stamp=None, verdict="dropped", reasons=(_DROPPED,)) for i in self.source.dropped]
        return sorted(rows, key=lambda row: row.index)

    def covariances(self) -> NDArray[np.float64] | None:
        """Return the covariances (N, 6, 6) of the first camera's tracked poses, or None if one is unknown."""
        tracked = [r.covariance for r in self.slam.results if r.T_world_camera is not None and not r.camera_name]
        if any(covariance is None for covariance in tracked):
            return None
        return np.array(tracked, dtype=np.float64).reshape(-1, 6, 6)
