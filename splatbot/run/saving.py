"""Saving a run at intervals, including the state of the loop over its frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.run.loop import FrameLoop
from splatbot.run.state.checkpoint import Checkpoint, LogPlace, SavedRun, checksum

# Fields that belong to one process, or that the resuming process sets again.
_NOT_SAVED = {
    "source",
    "slam",
    "config",
    "on_bad_frame",
    "on_progress",
    "saver",
    "error",
    "crash",
    "first_bad",
    "started",
    "cut",
    "begin",
}


class Saver:
    """Saves a run every so often, and when its frames are through.

    Args:
        checkpoint: folder and interval of the saves.
        log: log of the run.
        camera: camera file that the log was opened with.
        write_results: writes the files that other programs read (map, trajectory, metrics so far).
        robot: robot that is masked in the frames.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        log: Log,
        camera: str | None,
        write_results: Callable[[], None] | None = None,
        *,
        robot: str | None = None,
    ) -> None:
        self.checkpoint = checkpoint
        self.write_results = write_results
        self._log, self._camera, self._robot = log, camera, robot
        self._last: Frame | None = None
        self._index: int | None = None

    def processed(self, loop: FrameLoop, frame: Frame, index: int) -> None:
        """Save the run if the interval has passed since the last save; called after each processed frame.

        A save that the disk does not take is reported and tried again after the interval: mapping goes on.
        """
        self._last, self._index = frame, index
        if not self.checkpoint.due:
            return
        try:
            self.save(loop)
            if self.write_results is not None:
                self.write_results()
        except OSError as error:
            loop.progress("saving", warning=f"not saved, mapping goes on: {error}")

    def save(self, loop: FrameLoop) -> None:
        """Save the run between two frames.

        Raises:
            OSError: the disk is full or not available.
            KeyboardInterrupt: the progress callback raised it. The save is complete.
        """
        if self._last is None:
            return
        interrupts: list[KeyboardInterrupt] = []

        def report(step: int, steps: int) -> None:
            try:
                loop.progress("saving", step=step, steps=steps)
            except KeyboardInterrupt as interrupt:
                interrupts.append(interrupt)

        place = LogPlace(
            name=self._log.name,
            uri=self._log.uri,
            frames=len(self._log),
            camera=self._camera,
            next_index=loop.done,
            last_index=self._index,
            last_stamp=float(self._last.stamp),
            last_checksum=checksum(self._last),
            robot=self._robot,
        )
        self.checkpoint.save(
            loop.slam,
            loop_state(loop),
            place,
            loop.config,
            report,
        )
        if interrupts:
            raise interrupts[0]

    @property
    def cost(self) -> dict[str, Any]:
        """Number of saves and their duration [s]."""
        return {"count": self.checkpoint.saves, "seconds": round(self.checkpoint.seconds, 3)}


def loop_state(loop: FrameLoop) -> dict[str, Any]:
    """Return the counters of the loop by name, and the frames that its source dropped or delivered late."""
    counters = {f.name: getattr(loop, f.name) for f in fields(loop) if f.name not in _NOT_SAVED}
    return {"loop": counters, "source": {"dropped": loop.source.dropped, "late": loop.source.late}}


def first_frame_of(saved: SavedRun) -> int:
    """Return the index of the first frame of a saved run: all later ones were read, skipped or dropped."""
    loop = saved.loop["loop"]
    return saved.place.next_index - len(loop["ms"]) - len(loop["skipped"]) - len(saved.loop["source"]["dropped"])


def resume_loop(loop: FrameLoop, saved: SavedRun) -> None:
    """Restore the state of a saved loop into a new one, which begins at the same frame."""
    for name, value in saved.loop["loop"].items():
        setattr(loop, name, value)
    loop.source.first = saved.place.next_index
    loop.source.dropped, loop.source.late = saved.loop["source"]["dropped"], saved.loop["source"]["late"]
