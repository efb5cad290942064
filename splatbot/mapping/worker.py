"""Mapping beside tracking: a thread that takes keyframes in and refines while the tracker goes on."""

from __future__ import annotations

import atexit
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from weakref import WeakSet

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.gaussians import Snapshot
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.mapper import Mapper, Observation
from splatbot.mapping.refine import Stop, never
from splatbot.priority import lower_priority, switch_quickly
from splatbot.rasterize.native import native
from splatbot.tracking.features import Features
from splatbot.tracking.prepare import PreparedFrame

_NICENESS = 10  # of the thread: where cores are short, the tracker goes first
_CHUNK = 1  # refinement steps between two looks at what has arrived
_begun: WeakSet[MappingWorker] = WeakSet()


class MappingWorker:
    """The face of a :class:`Mapper`, whose work is done in a thread of its own.

    The tracker hands over observations and reads ``keyframes``; it waits for neither fusion nor refinement. New lists
    of keyframes and new references take the place of old ones by assignment: a reader sees the one or the other. What
    goes wrong in the thread is raised by the next call of :meth:`wants`, :meth:`insert` or :meth:`finish`.

    Args:
        mapper: fresh; the worker's alone from here on.
        backlog: observations that may wait; while so many do, no frame is wanted.
    """

    def __init__(self, mapper: Mapper, *, backlog: int = 3) -> None:
        self._mapper = mapper
        self._backlog = backlog
        self._waiting: deque[Observation] = deque()
        self._unfused: deque[tuple[Observation, Keyframe]] = deque()
        self._news = threading.Condition()
        self._to_look: tuple[PreparedFrame, NDArray[np.float64]] | None = None
        self._held = False
        self._ending = False
        self._error: BaseException | None = None
        self._published = mapper.snapshot()
        self._thread: threading.Thread | None = None
        self._busy = self._paused = False
        self._pauses_wanted = 0

    def __getstate__(self) -> dict[str, Any]:
        """What is saved of a paused worker: all but the thread and what it waits with."""
        return {"_mapper": self._mapper, "_backlog": self._backlog, "_held": self._held}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["_mapper"], backlog=state["_backlog"])  # type: ignore[misc]
        self._held = state["_held"]

    @property
    def keyframes(self) -> list[Keyframe]:
        """Those that frames can be tracked against now."""
        return self._mapper.keyframes

    @property
    def size(self) -> int:
        """Number of Gaussians."""
        return self._mapper.size

    def wants(self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64]) -> bool:
        """As :meth:`Mapper.wants`; False while too many observations wait, or a loop waits for those that do."""
        self._raise_error()
        to_come = self._to_come()
        room = len(to_come) < self._backlog and not self._mapper.has_loop
        return room and self._mapper.wants(prepared, T_world_camera, to_come)

    def insert(
        self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64], features: Callable[[], Features]
    ) -> None:
        """Hand over a frame and return at once; only the first is made a keyframe here: nothing is tracked before."""
        self._raise_error()
        self._waiting.append(Observation(prepared, T_world_camera, features, self._mapper.loops.anchor))
        if self._thread is None:
            self._take()
            self._start()
        with self._news:
            self._news.notify()

    @property
    def memory(self) -> dict[str, int]:
        """As :meth:`Mapper.memory`; while the thread works, of about now."""
        return self._mapper.memory

    @property
    def loop_counts(self) -> dict[str, int]:
        """As :meth:`Mapper.loop_counts`."""
        return self._mapper.loop_counts

    @property
    def skipped_gradients(self) -> int:
        """As :attr:`Mapper.skipped_gradients`."""
        return self._mapper.skipped_gradients

    @property
    def has_loop(self) -> bool:
        """As :meth:`Mapper.has_loop`; not while observations wait, for whoever closes it would wait for them."""
        return self._mapper.has_loop and not self._to_come()

    def close_loops(self) -> dict[int, NDArray[np.float64]]:
        """As :meth:`Mapper.close_loops`, while paused; what is owed is left to the thread."""
        self._to_look = None  # its pose is of the world as it was
        moved = self._mapper.close_loops(refine=False)
        self._publish()
        return moved

    def look(self, prepared: PreparedFrame, T_world_camera: NDArray[np.float64]) -> None:
        """As :meth:`Mapper.look`, when there is time; the latest frame only."""
        with self._news:
            self._to_look = (prepared, T_world_camera)
            self._news.notify()

    def hold(self, moving: bool) -> None:
        """As :meth:`Mapper.hold`."""
        with self._news:
            self._held = moving
            self._news.notify()

    def finish(self, stop: Stop = never) -> None:
        """End the thread once all observations are in the map, then refine in this one until ``stop`` says so."""
        self._end()
        self._raise_error()
        self._mapper.finish(stop)
        self._publish()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """A block in which the thread does nothing; waits until all observations are in the map, not for refinement."""
        with self._news:
            self._pauses_wanted += 1
            try:
                self._news.wait_for(self._may_pause)
                self._raise_error()
                self._paused = True
            finally:
                self._pauses_wanted -= 1
        try:
            yield
        finally:
            with self._news:
                self._paused = False
                self._news.notify_all()

    def _to_come(self) -> list[Observation]:
        """What is not in the map yet."""
        with self._news:
            return [*self._waiting, *(observation for observation, _ in self._unfused)]

    def _may_pause(self) -> bool:
        drained = not (self._waiting or self._unfused) or self._error is not None
        return drained and not self._busy and not self._paused

    def close(self) -> None:
        """End the thread once all observations are in the map; what went wrong in it has been or is not raised."""
        self._end()

    def snapshot(self) -> Snapshot:
        """The map as it was published last: after each keyframe's fusion, and when refinement has caught up."""
        return self._published

    def _publish(self) -> None:
        self._published = replace(self._mapper.snapshot(), map_version=self._published.map_version + 1)

    def _start(self) -> None:
        switch_quickly()  # the tracker waits for the interpreter while mapping holds it
        self._thread = threading.Thread(target=self._run, name="mapping", daemon=True)
        self._thread.start()
        _begun.add(self)

    def _end(self) -> None:
        with self._news:
            self._ending = True
            self._news.notify()
        if self._thread is not None:
            self._thread.join()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise RuntimeError("mapping has failed in its thread; the map is as it was before") from self._error

    def _run(self) -> None:
        _lower_priority()
        try:
            while (work := self._next()) is not None:
                work()
        except BaseException as error:  # raised where somebody can act on it
            with self._news:
                self._error, self._busy = error, False
                self._news.notify_all()

    def _next(self) -> Callable[[], None] | None:
        """What is to be done now; waits while there is nothing; None: the end."""
        with self._news:
            self._busy = False
            self._news.notify_all()
            while True:
                work = None if self._paused else self._choose()
                if work is not None:
                    self._busy = True
                    return work
                if self._ending and not self._paused:
                    return None
                self._news.wait()

    def _choose(self) -> Callable[[], None] | None:
        """What the tracker can use soonest: it follows the latest keyframe, whether that is in the map or not."""
        if self._waiting:
            return self._take
        if self._unfused:
            return self._fuse
        if self._ending or self._pauses_wanted:  # or whoever wants a pause would wait for all that is owed
            return None
        if self._to_look is not None:
            return self._look
        return self._refine if self._mapper.owed and not self._held else None

    def _take(self) -> None:
        # It leaves the queue after it has become a keyframe: one of the two must keep its like from being wanted.
        observation = self._waiting[0]
        keyframe = self._mapper.add_keyframe(observation, provisional=True)
        with self._news:
            self._unfused.append((observation, keyframe))
            self._waiting.popleft()

    def _fuse(self) -> None:
        observation, keyframe = self._unfused[0]
        self._mapper.fuse(observation, keyframe)
        self._mapper.make_reference(observation, keyframe)
        self._mapper.look_for_loops(observation, keyframe)
        self._publish()
        with self._news:
            self._unfused.popleft()

    def _look(self) -> None:
        with self._news:
            frame, self._to_look = self._to_look, None
        if frame is not None:
            self._mapper.look(*frame)

    def _refine(self) -> None:
        self._mapper.refine(_CHUNK)
        if not self._mapper.owed:
            self._publish()


def _lower_priority() -> None:
    """Leave cores and interpreter to the tracker: one native thread, one of torch, and a lower priority."""
    native().keep_to_this_thread(True)
    torch.set_num_threads(1)
    lower_priority(_NICENESS)


@atexit.register
def _end_all() -> None:
    """End the threads that nobody has ended: the interpreter, once it is being taken down, would abort for one."""
    for worker in list(_begun):
        worker.close()
