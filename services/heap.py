"""Memory that a long-lived process no longer uses: cycles of objects, and fragments that the C library keeps."""

from __future__ import annotations

import ctypes
import gc
import sys


def trim_heap() -> None:
    """Return freed memory to the operating system (glibc's ``malloc_trim``), where the C library can.

    The soak (`docs/experiments/attacks.md`) grows by 34 kB for each map with it, and by 54 kB without.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def freeze_imports() -> None:
    """Take the objects that live as long as the process, above all imported modules, out of garbage collection.

    A full collection runs only once the new objects are a quarter of the old ones. Imports make 400,000 objects, so
    that cycles of deleted maps would stay for long, and a collection would hold up every thread for 0.1 s.
    """
    gc.collect()
    gc.freeze()
