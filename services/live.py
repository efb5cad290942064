"""Maps frames while the map is served."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Protocol

from splatbot.errors import MapNotFoundError, SplatbotError
from splatbot.frame import Frame
from splatbot.gaussians import Snapshot
from splatbot.protocols import FrameSource
from splatbot.services.store import MapStore, State
from splatbot.services.topics import FRAME, RESULT, map_topic
from splatbot.slam import FrameResult
from splatbot.trajectory import Trajectory

_log = logging.getLogger(__name__)


class LiveMapper(Protocol):
    """The part that live mapping uses of :class:`splatbot.slam.Slam`."""

    def process(self, frame: Frame) -> FrameResult:
        """Track and fuse a frame."""
        ...

    def finish(self) -> None:
        """Refine once more at the end of the stream."""
        ...

    def snapshot(self) -> Snapshot:
        """Return the present map."""
        ...

    @property
    def trajectory(self) -> Trajectory:
        """Return the poses so far."""
        ...

    def close(self) -> None:
        """End the background threads."""
        ...


class LiveMapping:
    """Feeds frames to a mapper, publishes each result on the bus, and a snapshot at every keyframe.

    The map stays in the store when the frames end or fail: its state becomes "ended", or "failed" with the reason.
    :meth:`start` does so in a thread of its own, :meth:`run` in the caller's.

    Args:
        store: where ``map_id`` has been added.
        source: frames in their order: a log, a camera, or the frames that clients push.
        mapper: only the mapping thread touches it once started.
        on_result: called in the mapping thread after each frame.
    """

    def __init__(
        self,
        store: MapStore,
        map_id: str,
        source: Iterable[Frame],
        mapper: LiveMapper,
        *,
        on_result: Callable[[FrameResult], None] | None = None,
    ) -> None:
        self._store = store
        self._map_id = map_id
        self._source = source
        self._mapper = mapper
        self._on_result = on_result
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.run, name=f"mapping-{map_id}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self, timeout_s: float | None = None) -> None:
        """End after the frame in work; wait for that up to ``timeout_s`` [s] where a thread of its own does it."""
        self._stop.set()
        if isinstance(self._source, FrameSource):
            self._source.close()  # the thread may be waiting for a frame
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the frames up to ``timeout_s`` [s]; whether it has come."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def run(self) -> None:
        """Map until the frames end, :meth:`stop`, or an error, which becomes the map's state."""
        try:
            self._feed()
        except SplatbotError as error:
            _log.error("mapping %s stopped: %s", self._map_id, error)
            self._end("failed", error.message)
        except Exception:
            _log.exception("mapping %s failed", self._map_id)
            self._end("failed", "unexpected error; the service's log says more")
        else:
            self._end("ended")
        finally:
            self._mapper.close()

    def _feed(self) -> None:
        bus = self._store.bus
        frame_topic, result_topic = map_topic(self._map_id, FRAME), map_topic(self._map_id, RESULT)
        shown = -1
        for frame in self._source:
            if self._stop.is_set():
                break
            bus.publish(frame_topic, frame)
            with self._store.frames_first.mapping():
                result = self._mapper.process(frame)
            bus.publish(result_topic, result)
            if result.keyframe:
                self._publish()
                shown = result.index
            if self._on_result is not None:
                self._on_result(result)
        if not self._stop.is_set():
            self._mapper.finish()
            self._publish()
        elif shown >= 0:
            self._publish()  # without the final refinement: a stop request wants a quick end

    def _publish(self) -> None:
        self._store.publish(self._map_id, self._mapper.snapshot(), self._mapper.trajectory)

    def _end(self, state: State, detail: str | None = None) -> None:
        with suppress(MapNotFoundError):  # deleted meanwhile
            self._store.set_state(self._map_id, state, detail)
