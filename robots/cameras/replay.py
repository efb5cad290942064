"""A recording that behaves as a camera: frames at their times, dropped if the reader is slow, with device faults."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np

from splatbot.camera import Camera
from splatbot.errors import DeviceError, InputError
from splatbot.frame import Frame
from splatbot.layouts import REPLAY as PREFIX
from splatbot.logs import Log, open_log
from splatbot.logs.calibration import Calibration

_QUEUE = 4  # frames that a driver buffers for a slow reader, the default of depthai's queues
_END = object()


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay; frames are counted from 0.

    Args:
        speed: playback speed; 2 plays twice as fast. The stamps do not change.
        loop: start again at the end; stamps continue to increase.
        stall: index of the frame that is delayed by ``stall_s``, -1 for never.
        stall_s: delay [s].
        drop: fraction of frames that the device loses, 0..1.
        corrupt: fraction of frames whose transfer is interrupted, so that the lower half is noise.
        unplug: index of the frame at which the device disconnects, -1 for never.
        replug_s: time [s] after which it can be opened again, with the next frame; 0 for never.
        fault_seed: seed of the dropped and corrupted frames.
    """

    speed: float = 1.0
    loop: bool = False
    stall: int = -1
    stall_s: float = 1.0
    drop: float = 0.0
    corrupt: float = 0.0
    unplug: int = -1
    replug_s: float = 0.0
    fault_seed: int = 0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("speed", 1e-3, 1e3),
            ("stall_s", 0, 3600),
            ("replug_s", 0, 3600),
            ("drop", 0, 1),
            ("corrupt", 0, 1),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"is {value}.", field=f"replay {name}", hint=f"give a number in {low:g}..{high:g}")


class ReplayCamera:
    """A log as a live camera. A slow reader loses the oldest frames, which ``dropped`` counts.

    Iterating starts a thread that reads the log and delivers each frame at its time; a log that itself is too slow
    delivers late. The frames end with the log, or by :meth:`close`. A camera that was unplugged goes on where it was,
    with its clock, when it is iterated again after ``replug_s``.

    Attributes:
        dropped: frames that a slow reader lost.
        lost: frames that the device lost, by the option ``drop``.
        corrupted: frames that were delivered with noise, by the option ``corrupt``.

    Args:
        log: any log.
        options: how it is played.

    Raises:
        DeviceError: when iterating: the device was unplugged.
        LogError: when iterating: a frame cannot be read.
    """

    def __init__(self, log: Log, options: ReplayOptions | None = None) -> None:
        self.options = options or ReplayOptions()
        self.name = log.name
        self.uri = PREFIX + log.uri
        self.camera: Camera = log.camera
        self.dropped = self.lost = self.corrupted = 0
        self._log = log
        self._number, self._offset = 0, 0.0  # of the next frame, and [s] from the log's clock to the camera's
        self._gone_until: float | None = None  # [s] of the monotonic clock, while unplugged
        self._closed_by_user = False
        self._queue: deque[Frame | BaseException | object] = deque()
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._rng = np.random.default_rng(self.options.fault_seed)

    @classmethod
    def from_uri(cls, uri: str, *, joint_delay: float = 0.0) -> ReplayCamera:
        """Open the camera of `replay:LOG?speed=2&loop=1&...`; other options are passed to the log.

        ``joint_delay`` is that of :func:`splatbot.logs.open_log`.

        Raises:
            InputError: an option is no number or out of range.
            LogError: the log cannot be opened.
        """
        log, _, query = uri.removeprefix(PREFIX).partition("?")
        kinds: dict[str, type] = {name: type(value) for name, value in asdict(ReplayOptions()).items()}
        pairs = [pair for pair in query.split("&") if pair]
        values = {}
        for key, _, text in (pair.partition("=") for pair in pairs if pair.partition("=")[0] in kinds):
            try:
                values[key] = bool(int(text)) if kinds[key] is bool else kinds[key](text)
            except ValueError as error:
                raise InputError(f"is {text!r}.", field=f"replay {key}", hint="give a number") from error
        own = "&".join(pair for pair in pairs if pair.partition("=")[0] not in kinds)
        recording = open_log(log + (f"?{own}" if own else ""), joint_delay=joint_delay)
        return cls(recording, ReplayOptions(**values))

    @property
    def calibration(self) -> Calibration:
        """Calibration of the log, with its values of the sensor."""
        return self._log.calibration

    def close(self) -> None:
        """End the stream; a waiting reader receives no further frame."""
        self._closed_by_user = True
        self._end()

    def _end(self) -> None:
        self._closed.set()
        with self._changed:
            self._changed.notify_all()

    def __iter__(self) -> Iterator[Frame]:
        if self._closed_by_user:
            return
        if self._gone_until is not None:
            if time.monotonic() < self._gone_until:
                raise self._gone()
            self._offset, self._gone_until = self._offset + self.options.replug_s, None
        self._closed, self._queue = threading.Event(), deque()
        threading.Thread(target=self._run, name=f"camera-{self.name}", daemon=True).start()
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._queue or self._closed.is_set())
                    taken = _END if self._closed.is_set() else self._queue.popleft()
                if taken is _END:
                    return
                if isinstance(taken, BaseException):
                    raise taken
                assert isinstance(taken, Frame)
                yield taken
        finally:
            self._end()

    def _gone(self) -> DeviceError:
        return DeviceError("is gone.", file=self.uri, field="camera", hint="plug it in and start again")

    def _run(self) -> None:
        closed, unplug = self._closed, self.options.unplug
        try:
            for number, frame in self._frames(closed):
                self._number = number + 1
                if number == unplug:
                    self._gone_until = time.monotonic() + (self.options.replug_s or np.inf)
                    raise self._gone()
                if self._rng.random() < self.options.drop:
                    self.lost += 1
                elif self._rng.random() < self.options.corrupt:
                    self.corrupted += 1
                    self._deliver(self._damaged(frame))
                else:
                    self._deliver(frame)
                if closed.is_set():
                    return
            self._deliver(_END)
        except Exception as error:
            self._deliver(error)

    def _frames(self, closed: threading.Event) -> Iterator[tuple[int, Frame]]:
        """Yield frames at their times, numbered over all loops, from the next one until the camera is closed."""
        number, offset, late = self._number, self._offset, 0.0
        begun: tuple[float, float] | None = None
        while True:
            period = last = 0.0
            for index in range(number % len(self._log) if self.options.loop else number, len(self._log)):
                frame = self._log.read(index)
                stamp = frame.stamp + offset
                begun = begun or (time.monotonic(), stamp)
                late += self.options.stall_s if number == self.options.stall else 0.0
                due = begun[0] + (stamp - begun[1]) / self.options.speed + late
                if closed.wait(max(due - time.monotonic(), 0.0)):
                    return
                yield number, replace(frame.shifted(offset), index=number)
                period, last = (frame.stamp - last if last else 0.0), frame.stamp
                number += 1
            if not self.options.loop:
                return
            offset += last - self._log.read(0).stamp + (period or 1.0)
            self._offset = offset

    def _deliver(self, item: Frame | BaseException | object) -> None:
        with self._changed:
            if len(self._queue) >= _QUEUE and isinstance(item, Frame):
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(item)
            self._changed.notify_all()

    def _damaged(self, frame: Frame) -> Frame:
        """Replace the lower half of a frame by noise, as an interrupted transfer does."""
        rgb, depth, half = frame.rgb.copy(), frame.depth.copy(), frame.rgb.shape[0] // 2
        rgb[half:] = self._rng.integers(0, 256, rgb[half:].shape, dtype=np.uint8)
        depth[half:] = self._rng.uniform(0, 10, depth[half:].shape)
        return replace(frame, rgb=rgb, depth=depth)
