"""Access to the C++ core."""

from __future__ import annotations

import functools
import importlib
from types import ModuleType

from splatbot.errors import NativeError


@functools.cache
def native() -> ModuleType:
    """Return the extension module ``splatbot._native``.

    Raises:
        NativeError: it is missing, damaged, or its kernels cannot run on this CPU.
    """
    try:
        module = importlib.import_module("splatbot._native")
    except ImportError as error:
        raise NativeError(
            f"cannot be imported ({error}).", file="splatbot._native", hint="build it: pip install --editable ."
        ) from error
    try:
        module.isa()
        module.num_threads()
    except (RuntimeError, ValueError) as error:
        raise NativeError(
            f"{error}.", file="splatbot._native", hint="check SPLATBOT_ISA and SPLATBOT_NUM_THREADS"
        ) from error
    return module
