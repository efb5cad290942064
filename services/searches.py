"""Running searches of planners, which end early when the service stops."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from splatbot.planning import GaussianRRTStar
from splatbot.services.problems import BusyError


class Searches:
    """Planners that search at present."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[GaussianRRTStar] = set()
        self._stopped = False

    @contextmanager
    def running(self, planner: GaussianRRTStar) -> Iterator[None]:
        """Count a planner as searching during the block.

        Raises:
            BusyError: the service stops.
        """
        with self._lock:
            if self._stopped:
                raise BusyError("the service is stopping.", hint="plan again when it has restarted")
            self._running.add(planner)
        try:
            yield
        finally:
            with self._lock:
                self._running.discard(planner)

    def stop(self) -> None:
        """End all searches with their best paths so far, and refuse later ones."""
        with self._lock:
            self._stopped = True
            for planner in self._running:
                planner.cancel()
