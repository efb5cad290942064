"""Maps frames while the map is served."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Protocol

from splatbot.errors import MapNotFoundError, SplatbotError
from splatbot.frame import Frame
from splatbot.gaussians import Snapshot
from splatbot.mapping.further_camera import FurtherCamera
from splatbot.protocols import FrameSource
from splatbot.services.store import MapStore, ServedMap, State
from splatbot.services.threads import join_started
from splatbot.services.topics import FRAME, RESULT, of_camera
from splatbot.services.turns import Turns
from splatbot.slam import FrameResult
from splatbot.trajectory import Trajectory

_log = logging.getLogger(__name__)


class FrameError(SplatbotError):
    """A frame made mapping fail; the map goes on without it."""


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
        """Return the poses of the first camera so far."""
        ...

    @property
    def further_cameras(self) -> Mapping[str, FurtherCamera]:
        """Return the cameras other than the first one, by name."""
        ...

    def close(self) -> None:
        """End the background threads."""
        ...


class LiveMapping:
    """Feeds frames to a mapper, publishes each result on the bus, and a snapshot at every keyframe.

    Frames and results of further cameras have topics of their own, and ``served.cameras`` describes these cameras.

    The map stays in the store when the frames end or fail: its state becomes "ended", or "failed" with the reason.
    :meth:`start` does so in a thread of its own, :meth:`run` in the caller's.

    Args:
        store: store of the map.
        served: map that receives the frames; once it is deleted, mapping ends.
        source: frames in their order: a log, a camera, or the frames that clients push.
        mapper: only the mapping thread touches it once started, or a thread for which mapping is :meth:`paused`.
        on_result: called in the mapping thread after each frame.
        on_error: called in the mapping thread with the index of a frame that cannot be mapped; mapping goes on. If
            None, such a frame ends it.
        on_mapped: called in the mapping thread with the mapper once all frames are mapped, or :meth:`stop` was called.
        on_end: called in the mapping thread at its end.
    """

    def __init__(
        self,
        store: MapStore,
        served: ServedMap,
        source: Iterable[Frame],
        mapper: LiveMapper,
        *,
        on_result: Callable[[FrameResult], None] | None = None,
        on_error: Callable[[int, SplatbotError], None] | None = None,
        on_mapped: Callable[[LiveMapper], None] = lambda _mapper: None,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._store = store
        self._served = served
        self._source = source
        self.mapper = mapper
        self._on_result = on_result
        self._on_error = on_error
        self._on_mapped = on_mapped
        self._on_end = on_end
        self._turns = Turns()
        self._ended = False
        served.cameras.update(mapper.further_cameras)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.run, name=f"mapping-{served.id}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self, timeout_s: float | None = None) -> None:
        """End after the frame in work; wait for that up to ``timeout_s`` [s] where a thread of its own does it."""
        self._stop.set()
        if isinstance(self._source, FrameSource):
            self._source.close()  # the thread may be waiting for a frame
        join_started([self._thread], timeout_s)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the frames up to ``timeout_s`` [s]; whether it has come."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @contextmanager
    def paused(self, timeout_s: float) -> Iterator[bool]:
        """Enter between two frames, with the state of :attr:`mapper` published; False once mapping has ended.

        Raises:
            BusyError: a frame is mapped for longer than ``timeout_s`` [s].
            MapNotFoundError: the map was deleted.
        """
        with self._turns.between_frames(timeout_s):
            if not self._ended and (snapshot := self.mapper.snapshot()).map_version:
                self._publish(snapshot)
            yield not self._ended

    def go_on_with(self, mapper: LiveMapper) -> None:
        """Map the next frames with another mapper; call it while :meth:`paused`."""
        self.mapper.close()
        self.mapper = mapper
        self._served.cameras.update(mapper.further_cameras)

    def run(self) -> None:
        """Map until the frames end, :meth:`stop`, or an error, which becomes the map's state."""
        try:
            self._feed()
        except MapNotFoundError:
            _log.info("mapping %s stopped: the map was deleted", self._served.id)
        except SplatbotError as error:
            _log.error("mapping %s stopped: %s", self._served.id, error)
            self._end("failed", error.message)
        except Exception:
            _log.exception("mapping %s failed", self._served.id)
            self._end("failed", "unexpected error; the service's log says more")
        else:
            self._end("ended")
        finally:
            with self._turns.frame():
                self._ended = True
                self.mapper.close()
            self._on_end()

    def _feed(self) -> None:
        shown = -1
        for frame in self._source:
            if self._stop.is_set():
                break
            with self._turns.frame():
                result = self._map(frame)
            if result is not None and result.keyframe:
                shown = result.index
        with self._turns.frame():
            if not self._stop.is_set():
                self.mapper.finish()
                self._publish()
            elif shown >= 0:
                self._publish()  # without the final refinement: a stop request wants a quick end
            self._on_mapped(self.mapper)

    def _map(self, frame: Frame) -> FrameResult | None:
        """Map a frame, and publish its result; return None if it cannot be mapped."""
        self._store.tell(self._served, of_camera(frame.camera_name, FRAME), frame)
        result = self._process(frame)
        if result is None:
            return None
        self._served.cameras.update(self.mapper.further_cameras, result)
        self._store.tell(self._served, of_camera(result.camera_name, RESULT), result)
        if result.keyframe:
            self._publish()
        if self._on_result is not None:
            self._on_result(result)
        return result

    def _process(self, frame: Frame) -> FrameResult | None:
        """Map a frame; if it fails, call ``on_error`` and return None."""
        try:
            with self._store.frames_first.mapping():
                return self.mapper.process(frame)
        except Exception as error:
            if self._on_error is None:
                raise
            if not isinstance(error, SplatbotError):
                _log.exception("frame %d of map %s cannot be mapped", frame.index, self._served.id)
                hint = "push the next frame; the service's log says more"
                error = FrameError("the frame cannot be mapped; the map is as it was before.", hint=hint)
            self._on_error(frame.index, error)
            return None

    def _publish(self, snapshot: Snapshot | None = None) -> None:
        served, mapper = self._served, self.mapper
        present = snapshot or mapper.snapshot()
        self._store.publish(served.id, present, mapper.trajectory, generation=served.generation)

    def _end(self, state: State, detail: str | None = None) -> None:
        with suppress(MapNotFoundError):  # deleted meanwhile
            self._store.set_state(self._served.id, state, detail, generation=self._served.generation)
