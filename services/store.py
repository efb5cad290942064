"""The maps that are served, each at its latest immutable state."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

from splatbot.collision import GaussianCollisionField
from splatbot.errors import MapNotFoundError
from splatbot.gaussians import Snapshot
from splatbot.services.problems import MapNotReadyError

# "static": from a file; the others: being mapped from a log, which ended, or broke (what was mapped is still served).
State = Literal["static", "mapping", "ended", "failed"]


@dataclass(frozen=True)
class ServedMap:
    """One map at one moment; holds still while a request works on it.

    Args:
        id: its name in URLs.
        source: what it is made from, for people.
        state: how it came about, and whether it is still growing.
        detail: why it failed.
        snapshot: None before the first state is published.
    """

    id: str
    source: str
    state: State
    detail: str | None = None
    snapshot: Snapshot | None = None

    @property
    def map_version(self) -> int:
        """The state's number, 0 before the first."""
        return self.snapshot.map_version if self.snapshot else 0

    @property
    def ready(self) -> Snapshot:
        """The snapshot.

        Raises:
            MapNotReadyError: nothing is published yet.
        """
        if self.snapshot is None:
            because = f" because mapping failed: {self.detail}" if self.state == "failed" else " yet"
            raise MapNotReadyError(f"Map {self.id!r} has no state{because}.", hint="see GET /v1/maps for its progress")
        return self.snapshot

    @cached_property
    def field(self) -> GaussianCollisionField:
        """The collision field of this state, built by the first question.

        Raises:
            MapNotReadyError: nothing is published yet.
        """
        return GaussianCollisionField(self.ready)


class MapStore:
    """Maps by id. Writers swap whole states, readers keep the one they took: nobody waits for a computation."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._maps: dict[str, ServedMap] = {}

    def add(self, map_id: str, *, source: str, state: State, snapshot: Snapshot | None = None) -> None:
        """Serve a map under a new name.

        Raises:
            ValueError: the name is taken.
        """
        with self._lock:
            if map_id in self._maps:
                raise ValueError(f"map {map_id!r} exists")
            self._maps[map_id] = ServedMap(map_id, source, state, snapshot=snapshot)

    def publish(self, map_id: str, snapshot: Snapshot) -> None:
        """Let ``snapshot`` be the map's latest state; one that is not newer is ignored, so versions only grow.

        Raises:
            MapNotFoundError: no map of that name.
        """
        with self._lock:
            current = self._find(map_id)
            if current.snapshot is None or snapshot.map_version > current.map_version:
                self._maps[map_id] = replace(current, snapshot=snapshot)

    def set_state(self, map_id: str, state: State, detail: str | None = None) -> None:
        """Tell how the map's making goes.

        Raises:
            MapNotFoundError: no map of that name.
        """
        with self._lock:
            self._maps[map_id] = replace(self._find(map_id), state=state, detail=detail)

    def get(self, map_id: str) -> ServedMap:
        """The map's latest state.

        Raises:
            MapNotFoundError: no map of that name.
        """
        with self._lock:
            return self._find(map_id)

    def list(self) -> tuple[ServedMap, ...]:
        """All maps at their latest states, in the order in which they were added."""
        with self._lock:
            return tuple(self._maps.values())

    def _find(self, map_id: str) -> ServedMap:
        if map_id not in self._maps:
            names = ", ".join(self._maps) or "none"
            raise MapNotFoundError(f"No map {map_id!r}.", hint=f"the maps are: {names}")
        return self._maps[map_id]
