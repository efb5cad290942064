"""Access to the C++ code that benchmarks compare the core with."""

from __future__ import annotations

import functools
from types import ModuleType

from splatbot.rasterize.native import load_extension


@functools.cache
def bench_native() -> ModuleType:
    """Return the extension module ``splatbot._bench_native``.

    Raises:
        NativeError: it is missing or damaged.
    """
    return load_extension("splatbot._bench_native")
