"""Freed memory returns to the operating system."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import psutil  # type: ignore[import-untyped]
import pytest

from splatbot.services.heap import trim_heap

_C = ctypes.CDLL(None)


@pytest.mark.skipif(not hasattr(_C, "malloc_trim"), reason="this C library returns memory by itself, or not at all")
def test_freed_fragments_below_a_used_one_are_returned() -> None:
    _C.malloc.restype, _C.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    blocks = [_C.malloc(50_000) for _ in range(4000)]  # 200 MB, below the threshold of mmap
    for block in blocks:
        ctypes.memset(block, 1, 50_000)
    for block in blocks[:-1]:
        _C.free(block)
    before = psutil.Process().memory_info().rss
    trim_heap()
    assert psutil.Process().memory_info().rss < before - 150e6
    _C.free(blocks[-1])
    trim_heap()  # nothing to return is no error


def test_full_collections_leave_out_what_was_imported() -> None:
    # in its own process, because frozen objects stay frozen
    program = (
        "import gc, time, splatbot.slam\n"
        "from splatbot.services.heap import freeze_imports\n"
        "gc.collect(); start = time.perf_counter(); gc.collect(); before = time.perf_counter() - start\n"
        "freeze_imports()\n"
        "start = time.perf_counter(); gc.collect(); after = time.perf_counter() - start\n"
        "print(gc.get_freeze_count(), len(gc.get_objects()), before, after)\n"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    frozen, left, before, after = (float(word) for word in ran.stdout.split())
    assert frozen > 100_000
    assert left < 0.02 * frozen
    print(f"a full collection took {1e3 * before:.1f} ms, and {1e3 * after:.2f} ms afterwards")
