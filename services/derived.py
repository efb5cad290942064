"""Cache of results that are computed once from one version of a map."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Any, TypeVar

_T = TypeVar("_T")


class Derived:
    """The latest results by key. The first request computes a result; concurrent requests for it wait.

    Args:
        capacity: results that are kept.
    """

    def __init__(self, capacity: int = 8) -> None:
        self._capacity = capacity
        self._lock = threading.Lock()
        self._results: OrderedDict[Hashable, Future[Any]] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], _T]) -> _T:
        """Return the result of ``make()`` for ``key``. An exception reaches all waiting callers and is not cached."""
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
