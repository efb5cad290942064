"""When a run is saved while it goes on, and what of the loop over its frames is saved with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.run.loop import FrameLoop
from splatbot.run.state.checkpoint import Checkpoint, LogPlace, SavedRun, checksum

# What belongs to one process, or is given anew by the one who resumes.
_NOT_SAVED = {"source", "slam", "config", "on_bad_frame", "tell", "saver", "error", "crash", "first_bad", "started"}


class Saver:
    """Saves a run every so often, and when its frames are through.

    Args:
        checkpoint: where to, and how often.
        log: that is read; ``camera`` is what it was opened with, ``robot`` what was left out of its frames.
        write_results: writes the files that other programs read (map, trajectory, figures so far).
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
        """A frame has been processed: save if it is time."""
        self._last, self._index = frame, index
        if self.checkpoint.due:
            self.save(loop)
            if self.write_results is not None:
                self.write_results()

    def save(self, loop: FrameLoop) -> None:
        """Save the run between two frames."""
        if self._last is None:
            return
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
        self.checkpoint.save(loop.slam, loop_state(loop), place, loop.config)

    @property
    def cost(self) -> dict[str, Any]:
        """How often was saved, and the seconds that took."""
        return {"count": self.checkpoint.saves, "seconds": round(self.checkpoint.seconds, 3)}


def loop_state(loop: FrameLoop) -> dict[str, Any]:
    """The loop's counters by name, and which frames its source has dropped or given late."""
    counters = {f.name: getattr(loop, f.name) for f in fields(loop) if f.name not in _NOT_SAVED}
    return {"loop": counters, "source": {"dropped": loop.source.dropped, "late": loop.source.late}}


def resume_loop(loop: FrameLoop, saved: SavedRun) -> None:
    """Let a fresh loop go on where a saved one was."""
    for name, value in saved.loop["loop"].items():
        setattr(loop, name, value)
    loop.source.first = saved.place.next_index
    loop.source.dropped, loop.source.late = saved.loop["source"]["dropped"], saved.loop["source"]["late"]
