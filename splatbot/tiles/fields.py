"""The latest collision fields of a tiled map, which its readers share."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future

from splatbot.tiles.field import TiledField

FieldKey = tuple[tuple[float, ...], tuple[float, ...], float, float]
"""Corners of the box [m], n_sigma and reach [m] of a field."""


class FieldCache:
    """Fields by box, up to a number of bytes. Concurrent requests for one field wait for the first of them.

    The first query of a field may enlarge it by a table of covers, which the next request counts.

    Args:
        most_bytes: memory of all kept fields; the least recently used ones leave it. A larger field is not kept.
    """

    def __init__(self, most_bytes: float) -> None:
        self.builds = 0
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._kept: OrderedDict[FieldKey, TiledField] = OrderedDict()
        self._in_work: dict[FieldKey, Future[TiledField]] = {}

    def get(self, key: FieldKey, build: Callable[[], TiledField]) -> TiledField:
        """Return the field of a key; an exception of ``build()`` reaches all waiting callers and is not kept."""
        with self._lock:
            kept = self._kept.get(key)
            if kept is not None:
                self._kept.move_to_end(key)
                self._trim()
                return kept
            other = self._in_work.get(key)
            if other is None:
                self.builds += 1
                self._in_work[key] = mine = Future[TiledField]()
        return self._built(key, build, mine) if other is None else other.result()

    def clear(self) -> None:
        """Drop all kept fields."""
        with self._lock:
            self._kept.clear()

    @property
    def nbytes(self) -> int:
        """Memory of the kept fields [bytes]."""
        with self._lock:
            return self._sum()

    def _built(self, key: FieldKey, build: Callable[[], TiledField], result: Future[TiledField]) -> TiledField:
        """Build a field, pass it to the waiting callers, and keep it."""
        field = None
        try:
            field = build()
        except BaseException as error:
            result.set_exception(error)
            raise
        else:
            result.set_result(field)
            return field
        finally:
            with self._lock:
                del self._in_work[key]
                if field is not None and field.nbytes <= self._most_bytes:
                    self._kept[key] = field
                    self._trim()

    def _trim(self) -> None:
        while self._sum() > self._most_bytes:
            self._kept.popitem(last=False)

    def _sum(self) -> int:
        return sum(field.nbytes for field in self._kept.values())
