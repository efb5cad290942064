"""Threads of the parts of the service."""

from __future__ import annotations

import threading
from collections.abc import Iterable


def join_started(threads: Iterable[threading.Thread], timeout_s: float | None) -> None:
    """Wait for the end of those that were started, each up to ``timeout_s`` [s]."""
    for thread in threads:
        if thread.is_alive():
            thread.join(timeout_s)
