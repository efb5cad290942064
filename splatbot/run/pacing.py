"""Frames of a log on demand, or in real time as from a camera: a frame is dropped when the next one arrives."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.logs.live import RecordedCamera

_MAX_DECODED = 8  # frames decoded in advance; the limit bounds memory


@dataclass(frozen=True)
class Arrival:
    """Frame ``index`` of a log, or the error on reading it."""

    index: int
    frame: Frame | InputError


class LogFrames:
    """The frames of a log from ``first`` to ``total``, on demand.

    Attributes:
        total: index after the last frame to deliver; 0 if it is unknown.
        first: index of the first frame to deliver; a resumed run has processed the earlier ones.
        dropped: frames that were not delivered before a newer one arrived.
        late: frames that were still being processed when a newer one arrived.
    """

    def __init__(self, log: Log, total: int) -> None:
        self.log = log
        self.total = total
        self.first = 0
        self.dropped: list[int] = []
        self.late: set[int] = set()

    @property
    def pace(self) -> str | None:
        """Timing of the frames, for reports; None for frames on demand."""
        return None

    @property
    def live(self) -> bool:
        """Return whether the frames come from a camera, which Ctrl-C ends."""
        return False

    def end(self) -> None:
        """End the frames of a camera; a log needs no end."""

    def __iter__(self) -> Generator[Arrival, None, None]:
        return (read(self.log, index) for index in range(self.first, self.total))


class PacedSource(LogFrames):
    """The frames at the times of their stamps, or at ``rate`` [Hz]: the newest is delivered, older ones are dropped.

    A thread decodes ahead. The clock stops while the log itself is too slow, for example because it ray-casts a scene.
    The dropped and late frames thus measure the consumer only.
    """

    def __init__(self, log: Log, total: int, rate: float | None = None) -> None:
        super().__init__(log, total)
        self.rate = rate

    @property
    def pace(self) -> str | None:
        """Timing of the frames: by their stamps or at a rate."""
        return "by stamps" if self.rate is None else f"{self.rate:g} Hz"

    def __iter__(self) -> Generator[Arrival, None, None]:
        reader, clock = _FrameReader(self.log, self.first, self.total), _Schedule(self.rate)
        try:
            while (arrival := reader.take(clock)) is not None:
                clock.sleep_until(arrival)
                if isinstance(arrival.frame, Frame) and self._superseded(arrival.frame, reader, clock):
                    self.dropped.append(arrival.index)
                    continue
                yield arrival
                if isinstance(arrival.frame, Frame) and self._superseded(arrival.frame, reader, clock):
                    self.late.add(arrival.index)
        finally:
            reader.stop()

    @staticmethod
    def _superseded(frame: Frame, reader: _FrameReader, clock: _Schedule) -> bool:
        """Return whether a newer frame of the same camera has arrived."""
        newer = reader.next_of(frame.camera_name)
        return newer is not None and clock.due(newer) <= time.perf_counter()


class CameraFrames(LogFrames):
    """The frames of a camera that is recorded: the newest is delivered, older ones are dropped."""

    log: RecordedCamera

    def __init__(self, log: RecordedCamera) -> None:
        super().__init__(log, total=0)

    @property
    def pace(self) -> str | None:
        """Timing of the frames: that of the camera."""
        return "by the camera"

    @property
    def live(self) -> bool:
        """See :class:`LogFrames`."""
        return True

    def end(self) -> None:
        """End the stream of the camera."""
        self.log.end()

    def __iter__(self) -> Generator[Arrival, None, None]:
        expected = 0
        for index, frame in self.log.arrivals():
            self.dropped.extend(range(expected, index))
            yield Arrival(index, frame)
            if self.log.has_newer(frame):
                self.late.add(index)
            expected = index + 1


def read(log: Log, index: int) -> Arrival:
    """Read one frame; an InputError becomes part of the result."""
    try:
        return Arrival(index, log[index])
    except InputError as error:
        return Arrival(index, error)


class _Schedule:
    """Arrival times of frames [s, of time.perf_counter]; the first arrives at once."""

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._start = 0.0  # of frame 0, or of stamp 0
        self._started = False
        self._latest = 0.0

    def due(self, arrival: Arrival) -> float:
        """Return the arrival time of a frame, not before earlier ones; an unreadable one arrives with the previous."""
        if self._rate is not None:
            return self._start + arrival.index / self._rate
        return (
            max(self._latest, self._start + arrival.frame.stamp) if isinstance(arrival.frame, Frame) else self._latest
        )

    def add_decoding_wait(self, arrival: Arrival, since: float) -> None:
        """Stop the clock for the time that the consumer waited for the log to decode a frame, from ``since`` on."""
        now = time.perf_counter()
        if not self._started:
            self._begin(arrival, now)
        self._start += max(0.0, now - max(since, self.due(arrival)))

    def _begin(self, arrival: Arrival, now: float) -> None:
        self._latest = now
        if self._rate is not None:
            self._start = now - arrival.index / self._rate
        elif isinstance(arrival.frame, Frame):
            self._start = now - arrival.frame.stamp
        self._started = self._rate is not None or isinstance(arrival.frame, Frame)

    def sleep_until(self, arrival: Arrival) -> None:
        """Wait until the arrival time of a frame."""
        self._latest = self.due(arrival)
        time.sleep(max(0.0, self._latest - time.perf_counter()))


class _FrameReader:
    """Decodes frames in advance, in a separate thread."""

    def __init__(self, log: Log, first: int, total: int) -> None:
        self._log = log
        self._first, self._total = first, total
        self._ready: deque[Arrival] = deque()
        self._change = threading.Condition()
        self._left = max(0, total - first)
        self._stopped = False
        self._crash: Exception | None = None
        threading.Thread(target=self._run, name="reading", daemon=True).start()

    def take(self, clock: _Schedule) -> Arrival | None:
        """Return the next frame, after a wait if necessary; None after the last."""
        with self._change:
            since = time.perf_counter() if not self._ready else math.inf
            self._change.wait_for(lambda: self._ready or self._left == 0 or self._crash)
            if not self._ready:
                if self._crash is not None:
                    raise self._crash
                return None
            arrival = self._ready.popleft()
            self._change.notify_all()
        clock.add_decoding_wait(arrival, since)
        return arrival

    def next_of(self, camera_name: str) -> Arrival | None:
        """Return the next decoded frame of a camera without removing it; an unreadable frame replaces no other."""
        with self._change:
            frames = ((arrival, arrival.frame) for arrival in self._ready)
            return next((a for a, f in frames if isinstance(f, Frame) and f.camera_name == camera_name), None)

    def stop(self) -> None:
        """Stop decoding."""
        with self._change:
            self._stopped = True
            self._change.notify_all()

    def _run(self) -> None:
        try:
            for index in range(self._first, self._total):
                arrival = read(self._log, index)
                with self._change:
                    self._change.wait_for(lambda: len(self._ready) < _MAX_DECODED or self._stopped)
                    if self._stopped:
                        return
                    self._ready.append(arrival)
                    self._left -= 1
                    self._change.notify_all()
        except Exception as crash:  # a bug in a reader: the consumer raises it
            with self._change:
                self._crash = crash
                self._change.notify_all()
