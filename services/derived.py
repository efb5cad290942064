"""What is worked out from one state of a map, once for all who ask."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Any, TypeVar

_T = TypeVar("_T")


class Derived:
    """The latest results by key. The first who asks works one out, others who want it meanwhile wait for that.

    Args:
        capacity: results that are kept.
    """

    def __init__(self, capacity: int = 8) -> None:
        self._capacity = capacity
        self._lock = threading.Lock()
        self._results: OrderedDict[Hashable, Future[Any]] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], _T]) -> _T:
        """The result of ``make()`` for ``key``. What it raises is raised for all who wait, and not kept."""
        with self._lock:
            known = self._results.pop(key, None)
            result: Future[_T] = Future() if known is None else known
            self._results[key] = result
            if len(self._results) > self._capacity:
                self._results.popitem(last=False)
        if known is None:
            self._work_out(key, make, result)
        return result.result()

    def _work_out(self, key: Hashable, make: Callable[[], _T], result: Future[_T]) -> None:
        try:
            result.set_result(make())
        except BaseException as error:
            with self._lock:
                if self._results.get(key) is result:
                    del self._results[key]
            result.set_exception(error)
