"""Executors run the mapper's steps: in the calling thread, or in a thread of their own with a lower priority."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Protocol
from weakref import WeakSet

import torch

from splatbot.gaussians import Snapshot
from splatbot.mapping.mapper import Mapper
from splatbot.mapping.refine import Stop, never
from splatbot.priority import lower_priority, switch_quickly
from splatbot.rasterize.native import native

THREAD_NICENESS = 10
"""Niceness of the mapping thread: where cores are scarce, tracking runs first."""

_running: WeakSet[ThreadExecutor] = WeakSet()


class Executor(Protocol):
    """Decides when and in which thread :meth:`Mapper.step` runs."""

    def run(self) -> None:
        """Process the submitted work, or wake the thread that does.

        Raises:
            RuntimeError: mapping failed in its thread.
        """

    def paused(self) -> AbstractContextManager[None]:
        """Return a context in which no step runs and all submitted keyframes are in the map."""

    def finish(self, stop: Stop = never) -> None:
        """Insert all submitted keyframes, end the thread and refine the map a last time until ``stop`` returns True."""

    def close(self) -> None:
        """Insert all submitted keyframes and end the thread; never raises."""

    def snapshot(self) -> Snapshot:
        """Return an immutable copy of the map."""


class InlineExecutor:
    """Runs the mapper in the calling thread, in a fixed order: the same frames give the same map, bit for bit."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper

    def run(self) -> None:
        """Insert the submitted keyframe and refine, at most ``refine_iterations`` steps; undo all of it on an error."""
        with self._mapper.rollback_on_error():
            while self._mapper.has_observations:
                self._mapper.step()
            self._mapper.step(self._mapper.config.mapping.refine_iterations)

    def paused(self) -> AbstractContextManager[None]:
        """Return a context without effect: no step runs outside :meth:`run`."""
        return nullcontext()

    def finish(self, stop: Stop = never) -> None:
        """Refine the map a last time until ``stop`` returns True."""
        self._mapper.finish(stop)

    def close(self) -> None:
        """Return at once: there is no thread to end."""

    def snapshot(self) -> Snapshot:
        """Copy the map."""
        return self._mapper.snapshot()


class ThreadExecutor:
    """Runs the mapper in a thread; tracking waits for neither depth fusion nor refinement.

    The thread starts with the first :meth:`run`. That call turns the first observation into a keyframe itself, because
    there is no other keyframe to track the next frame against. An error in the thread is raised by the next call of
    :meth:`run`, :meth:`paused` or :meth:`finish`.

    Args:
        mapper: from here on its steps belong to the thread.
    """

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._published = mapper.snapshot()
        self._error: BaseException | None = None
        self._closing = self._stepping = self._paused = False
        self._pause_requests = 0

    def run(self) -> None:
        """Start or wake the thread."""
        self._raise_error()
        if self._thread is None and self._mapper.has_work and not self._closing:
            if self._mapper.has_keyframes_to_insert:
                self._mapper.step()
            self._start()
        with self._changed:
            self._changed.notify_all()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Wait until all submitted keyframes are in the map and the step in progress ends; stop the thread meanwhile.

        The wait does not include pending refinement.
        """
        with self._changed:
            self._pause_requests += 1
            try:
                self._changed.wait_for(self._can_pause)
                self._raise_error()
                self._paused = True
            finally:
                self._pause_requests -= 1
        try:
            yield
        finally:
            self._publish()
            with self._changed:
                self._paused = False
                self._changed.notify_all()

    def finish(self, stop: Stop = never) -> None:
        """End the thread once all submitted keyframes are in the map, then refine in this thread."""
        self.close()
        self._raise_error()
        self._mapper.finish(stop)
        self._publish()

    def close(self) -> None:
        """End the thread once all submitted keyframes are in the map; an error in it is not raised here."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def snapshot(self) -> Snapshot:
        """Return the map as published last, after the latest step that changed its version."""
        return self._published

    def _publish(self) -> None:
        if self._mapper.version != self._published.map_version:
            self._published = self._mapper.snapshot()

    def _start(self) -> None:
        switch_quickly()  # tracking waits for the interpreter lock while mapping holds it
        self._thread = threading.Thread(target=self._steps, name="mapping", daemon=True)
        self._thread.start()
        _running.add(self)

    def _raise_error(self) -> None:
        if self._error is not None:
            raise RuntimeError("mapping has failed in its thread; the map is as it was before") from self._error

    def _can_pause(self) -> bool:
        drained = not self._mapper.has_keyframes_to_insert or self._error is not None or self._thread is None
        return drained and not self._stepping and not self._paused

    def _steps(self) -> None:
        """Run steps until :meth:`close`; the thread's main function."""
        _lower_priority()
        try:
            while self._wait_for_work():
                self._mapper.step()
                self._publish()
        except BaseException as error:  # a call from the tracking thread raises it
            with self._changed:
                self._error, self._stepping = error, False
                self._changed.notify_all()

    def _wait_for_work(self) -> bool:
        """Wait until a step can run; return False when the thread has to end."""
        with self._changed:
            self._stepping = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._paused and (self._may_step() or self._closing))
            self._stepping = self._may_step()
            return self._stepping

    def _may_step(self) -> bool:
        """Return whether there is work; a pause or the end waits for keyframes, not for observations or refinement."""
        if self._closing or self._pause_requests:
            return self._mapper.has_keyframes_to_insert
        return self._mapper.has_work


def _lower_priority() -> None:
    """Leave cores and interpreter to tracking: one native thread, one torch thread and a lower priority."""
    native().keep_to_this_thread(True)
    torch.set_num_threads(1)
    lower_priority(THREAD_NICENESS)


@atexit.register
def _close_all() -> None:
    """End the threads that still run: the interpreter would abort if it were finalized under one."""
    for executor in list(_running):
        executor.close()
