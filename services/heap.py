"""Freed memory, which the C library keeps in fragments until it is requested to return it."""

from __future__ import annotations

import ctypes
import sys


def trim_heap() -> None:
    """Return freed memory to the operating system (glibc's ``malloc_trim``), where the C library can.

    The soak (`docs/experiments/attacks.md`) grows by 34 kB for each map with it, and by 54 kB without.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
