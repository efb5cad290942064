"""Progress of a run on stderr: a live line on a terminal, a plain line every two seconds elsewhere."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatbot.cli.loading import without_line

if TYPE_CHECKING:
    from splatbot.run import Progress


@dataclass(frozen=True)
class ProgressConstants:
    """Constants of the shown progress.

    Args:
        plain_period: [s] time between two lines of an output that is no terminal.
        rate_frames: number of frames that the shown rate averages.
        bar_width: [characters] width of the bar.
        wide_columns: [characters] width of the terminal from which all numbers are shown.
    """

    plain_period: float = 2.0
    rate_frames: int = 10
    bar_width: int = 12
    wide_columns: int = 110


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

    with without_line(), Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("", total=1.0)
        yield lambda what, share: bars.update(task, description=what, completed=share)


@contextmanager
def steps(quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Yield a callback that shows the current step of a command of some seconds on a terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda what: None
        return
    from rich.console import Console

    with without_line(), Console(stderr=True).status("") as status:
        yield lambda what: status.update(f"{what} ...")


class PlainLines:
    """Writes a line when two seconds have passed, a phase begins, or a frame is lost or unreadable."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._due = 0.0
        self._rate = FrameRate()
        self._verdict = "ok"
        self._phase = ""

    def __call__(self, progress: Progress) -> None:
        """Show the progress of the run, if it is due."""
        if progress.phase == "mapping":
            self._rate.add(progress)
        for notice in notices(progress):
            print(notice, file=sys.stderr, flush=True)
        verdict = progress.result.verdict if progress.result else self._verdict
        new_phase = progress.phase != self._phase and progress.phase != "mapping"
        news = new_phase or (verdict == "lost") != (self._verdict == "lost")
        self._verdict, self._phase = verdict, progress.phase
        last = progress.phase == "mapping" and progress.done == progress.total
        if news or last or self._clock() >= self._due:
            self._due = self._clock() + CONSTANTS.plain_period
            print(describe(progress, self._rate.value), file=sys.stderr, flush=True)


class FrameRate:
    """Frames per second over the latest frames."""

    def __init__(self) -> None:
        self._times: deque[tuple[int, float]] = deque(maxlen=CONSTANTS.rate_frames + 1)

    def add(self, progress: Progress) -> None:
        """Count a frame."""
        self._times.append((progress.done, progress.elapsed_s))

    @property
    def value(self) -> float:
        """The rate [1/s]; 0 before the second frame."""
        if len(self._times) < 2:
            return 0.0
        frames = self._times[-1][0] - self._times[0][0]
        seconds = self._times[-1][1] - self._times[0][1]
        return frames / seconds if seconds > 0 else 0.0


def notices(progress: Progress) -> list[str]:
    """Return the lines that stay: a frame that was skipped, a problem that did not end the run."""
    skipped = [f"skipped: {progress.skipped}"] if progress.skipped else []
    return skipped + ([f"warning: {progress.warning}"] if progress.warning else [])


def describe(progress: Progress, rate: float) -> str:
    """Return one line on the progress of the run."""
    if progress.phase != "mapping":
        return f"{progress.phase} {progress.step}/{progress.steps}" if progress.steps else f"{progress.phase} ..."
    verdict = progress.result.verdict if progress.result else "skipped"
    counts = mishaps(progress)
    return (
        f"frame {_of(progress.done, progress.total)}  {rate:.1f} fps  {progress.gaussians:,} Gaussians  "
        f"{progress.keyframes} keyframes  {verdict}" + (f"  ({counts})" if counts else "")
    )


def _of(done: int, total: int) -> str:
    return f"{done}/{total}" if total else str(done)


def mishaps(progress: Progress) -> str:
    """Return the counts of lost, late and dropped frames that are not zero."""
    counts = {"lost": progress.lost, "late": progress.late, "dropped": progress.dropped}
    return ", ".join(f"{count} {what}" for what, count in counts.items() if count)


@contextmanager
def _live() -> Iterator[Callable[[Progress], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    bars = Bars(
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=CONSTANTS.bar_width),
        TextColumn("{task.fields[counts]}"),
        TextColumn("{task.fields[numbers]}", table_column=_one_line()),
        TextColumn("[{task.fields[colour]}]{task.fields[verdict]}"),
        TimeRemainingColumn(compact=True),
        console=Console(stderr=True),
        transient=True,
    )
    rate = FrameRate()
    with without_line(), bars:
        task = bars.add_task("reading", total=None, counts="", numbers="", verdict="", colour="white")

        def show(progress: Progress) -> None:
            for notice in notices(progress):
                bars.console.print(notice, style="yellow", markup=False)
            mapping = progress.phase == "mapping"
            if mapping:
                rate.add(progress)
            total, done = (progress.total, progress.done) if mapping else (progress.steps, progress.step)
            if bars.tasks[task].description != progress.phase:
                bars.refresh()  # the last state of the phase before, which may be younger than the last redraw
                bars.reset(task)  # the time left is that of this phase
                bars.tasks[task].total = total or None  # reset and update take None as "as before"
            verdict = progress.result.verdict if progress.result and mapping else ""
            bars.update(
                task,
                description=progress.phase,
                total=total or None,
                completed=done,
                counts=_of(done, total) if total or mapping else "",
                numbers=_numbers(progress, rate.value, bars.console.width) if mapping else "",
                verdict=verdict,
                colour=_COLOURS.get(verdict, "white"),
            )

        yield show


def _one_line() -> Any:
    from rich.table import Column

    return Column(no_wrap=True, overflow="ignore")


def _numbers(progress: Progress, fps: float, columns: int) -> str:
    """Return the numbers of the mapping that fit next to the bar; the terminal may change its width."""
    counts = mishaps(progress)
    if columns < CONSTANTS.wide_columns:
        return f"{fps:.1f} fps" + (f"  {counts}" if counts else f"  {progress.gaussians:,} Gaussians")
    numbers = f"{fps:.1f} fps  {progress.gaussians:,} Gaussians  {progress.keyframes} keyframes"
    return numbers + (f"  {counts}" if counts else "")
