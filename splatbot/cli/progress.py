"""Progress of a run on stderr: a live line on a terminal, a plain line every two seconds elsewhere."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.run import Progress


@dataclass(frozen=True)
class ProgressConstants:
    """Constants of the shown progress.

    Args:
        plain_period: [s] time between two lines of an output that is no terminal.
        rate_frames: number of frames that the shown rate averages.
    """

    plain_period: float = 2.0
    rate_frames: int = 10


CONSTANTS = ProgressConstants()


_COLOURS = {"ok": "green", "degraded": "yellow", "lost": "red"}


@contextmanager
def progress_display(*, quiet: bool = False) -> Iterator[Callable[[Progress], None]]:
    """Yield a callback for :func:`splatbot.run.map_log` that shows progress during the block."""
    if quiet:
        yield lambda progress: None
    elif sys.stderr.isatty():
        with _live() as show:
            yield show
    else:
        yield PlainLines()


@contextmanager
def shares(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """Yield a callback that shows the current step and the finished share (0..1) on a terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda what, share: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("", total=1.0)
        yield lambda what, share: bars.update(task, description=what, completed=share)


class PlainLines:
    """Writes a line when two seconds have passed, a phase begins, or a frame is lost or unreadable."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due = 0.0
        self._rate = FrameRate()
        self._verdict = "ok"

    def __call__(self, progress: Progress) -> None:
        """Show the progress of the run, if it is due."""
        rate = self._rate.add(progress)
        if progress.skipped:
            print(f"skipped: {progress.skipped}", file=sys.stderr, flush=True)
        verdict = progress.result.verdict if progress.result else self._verdict
        news = progress.phase != "mapping" or (verdict == "lost") != (self._verdict == "lost")
        self._verdict = verdict
        if news or self._clock() >= self._due or progress.done == progress.total:
            self._due = self._clock() + CONSTANTS.plain_period
            print(describe(progress, rate), file=sys.stderr, flush=True)


class FrameRate:
    """Frames per second over the latest frames."""

    def __init__(self) -> None:
        self._times: deque[tuple[int, float]] = deque(maxlen=CONSTANTS.rate_frames + 1)

    def add(self, progress: Progress) -> float:
        """Return the rate [1/s] including this frame; 0 before the second."""
        self._times.append((progress.done, progress.elapsed_s))
        frames = self._times[-1][0] - self._times[0][0]
        seconds = self._times[-1][1] - self._times[0][1]
        return frames / seconds if seconds > 0 else 0.0


def describe(progress: Progress, rate: float) -> str:
    """Return one line on the progress of the run."""
    if progress.phase != "mapping":
        return f"{progress.phase} ..."
    verdict = progress.result.verdict if progress.result else "skipped"
    counts = mishaps(progress)
    return (
        f"frame {progress.done}/{progress.total}  {rate:.1f} fps  {progress.gaussians:,} Gaussians  "
        f"{progress.keyframes} keyframes  {verdict}" + (f"  ({counts})" if counts else "")
    )


def mishaps(progress: Progress) -> str:
    """Return the counts of lost, late and dropped frames that are not zero."""
    counts = {"lost": progress.lost, "late": progress.late, "dropped": progress.dropped}
    return ", ".join(f"{count} {what}" for what, count in counts.items() if count)


@contextmanager
def _live() -> Iterator[Callable[[Progress], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    bars = Bars(
        TextColumn("[bold]{task.fields[phase]}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[numbers]}"),
        TextColumn("[{task.fields[colour]}]{task.fields[verdict]}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    rate = FrameRate()
    with bars:
        task = bars.add_task("", total=None, phase="reading", numbers="", verdict="", colour="white")

        def show(progress: Progress) -> None:
            if progress.skipped:
                bars.console.print(f"skipped: {progress.skipped}", style="yellow", markup=False)
            fps = rate.add(progress)
            verdict = progress.result.verdict if progress.result else ""
            bars.update(
                task,
                total=progress.total,
                completed=progress.done,
                phase=progress.phase,
                numbers=f"{fps:.1f} fps  {progress.gaussians:,} Gaussians  {progress.keyframes} keyframes"
                + (f"  {mishaps(progress)}" if mishaps(progress) else ""),
                verdict=verdict,
                colour=_COLOURS.get(verdict, "white"),
            )

        yield show
