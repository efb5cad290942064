"""Access to the C++ core."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import torch

from splatbot.errors import NativeError


def load_extension(name: str) -> ModuleType:
    """Return the extension module of that name.

    Raises:
        NativeError: it is missing or damaged.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise NativeError(
            f"cannot be imported ({error}).", file=name, hint="build it: pip install --editable ."
        ) from error


@functools.cache
def native() -> ModuleType:
    """Return the extension module ``splatbot._native``.

    Raises:
        NativeError: it is missing, damaged, or its kernels cannot run on this CPU.
    """
    module = load_extension("splatbot._native")
    try:
        module.isa()
        module.num_threads()
    except (RuntimeError, ValueError) as error:
        raise NativeError(
            f"{error}.", file="splatbot._native", hint="check SPLATBOT_ISA and SPLATBOT_NUM_THREADS"
        ) from error
    return module


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Return a context in which PyTorch uses one thread: its threads spin after an operation, and starve the core's."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
