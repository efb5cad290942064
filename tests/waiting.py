"""Waiting for another thread or process."""

from __future__ import annotations

import time
from collections.abc import Callable


def until(found: Callable[[], object], timeout_s: float = 60.0) -> None:
    """Wait until ``found`` returns a true value, and fail after the timeout [s]."""
    deadline = time.monotonic() + timeout_s
    while not found():
        assert time.monotonic() < deadline, f"nothing came within {timeout_s:g} s"
        time.sleep(0.02)
