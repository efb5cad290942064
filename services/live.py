"""Maps a log in the background while the map is served."""

from __future__ import annotations

import logging
import threading
from typing import Protocol

from splatbot.errors import SplatbotError
from splatbot.frame import Frame
from splatbot.gaussians import Snapshot
from splatbot.logs import Log
from splatbot.services.store import MapStore
from splatbot.slam import FrameResult

_log = logging.getLogger(__name__)


class Mapper(Protocol):
    """What mapping needs of :class:`splatbot.slam.Slam`."""

    def process(self, frame: Frame) -> FrameResult:
        """Track and fuse a frame."""
        ...

    def finish(self) -> None:
        """Refine once more at the end of the stream."""
        ...

    def snapshot(self) -> Snapshot:
        """The map as it is now."""
        ...

    def close(self) -> None:
        """End what it runs in the background."""
        ...


class LiveMapping:
    """One thread that feeds a log to a mapper and publishes a snapshot at every keyframe.

    The map stays in the store whatever becomes of the log: its state turns to "ended", or to "failed" with the reason.

    Args:
        store: where ``map_id`` has been added.
        mapper: only this thread touches it once started.
    """

    def __init__(self, store: MapStore, map_id: str, log: Log, mapper: Mapper) -> None:
        self._store = store
        self._map_id = map_id
        self._source = log
        self._mapper = mapper
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"mapping-{map_id}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self, timeout_s: float | None = None) -> None:
        """End after the frame in work, and wait for that up to ``timeout_s`` [s]."""
        self._stop.set()
        self._thread.join(timeout_s)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the log's end up to ``timeout_s`` [s]; whether it has ended."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._feed()
        except SplatbotError as error:
            _log.error("mapping %s stopped: %s", self._map_id, error)
            self._store.set_state(self._map_id, "failed", error.message)
        except Exception:
            _log.exception("mapping %s failed", self._map_id)
            self._store.set_state(self._map_id, "failed", "unexpected error; the service's log says more")
        else:
            self._store.set_state(self._map_id, "ended")
        finally:
            self._mapper.close()

    def _feed(self) -> None:
        for frame in self._source:
            if self._stop.is_set():
                return
            if self._mapper.process(frame).keyframe:
                self._publish()
        self._mapper.finish()
        self._publish()

    def _publish(self) -> None:
        self._store.publish(self._map_id, self._mapper.snapshot())
