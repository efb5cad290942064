"""A line on the terminal while libraries are imported, which takes seconds on a busy machine."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, TextIO

_LINE = "loading ..."
ERASE = "\r" + " " * len(_LINE) + "\r"
"""Characters that remove the line from a terminal of any kind."""


@contextmanager
def imports_shown(stream: TextIO | None = None) -> Iterator[None]:
    """Show a line on a terminal during each import of the main thread in the block.

    The standard library and the command line itself are left out, because they load at once.

    Args:
        stream: the terminal; stderr by default. Other streams get no line.
    """
    shown = sys.stderr if stream is None else stream
    if not shown.isatty():
        yield
        return
    finder = _ShowingFinder(_Line(shown))
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


_displays = 0  # live displays, whose line is that of the terminal


@contextmanager
def without_line() -> Iterator[None]:
    """Show no line in the block, in which a live display draws the steps of a command."""
    global _displays
    _displays += 1
    try:
        yield
    finally:
        _displays -= 1


class _Line:
    """The line, which nested imports share."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._process = os.getpid()
        self._depth = 0

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the line, unless a live display is there; other threads and forked processes do not show it."""
        foreign = threading.current_thread() is not threading.main_thread() or os.getpid() != self._process
        if foreign or _displays:
            yield
            return
        if self._depth == 0:
            self._write(_LINE)
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            if self._depth == 0:
                self._write(ERASE)

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


class _ShowingFinder(MetaPathFinder):
    """Finds modules by the other finders, and shows the line while they load."""

    def __init__(self, line: _Line) -> None:
        self._line = line

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the specification of a module that loads slowly; None leaves the others to the next finder."""
        if fullname.partition(".")[0] in sys.stdlib_module_names or fullname.startswith("splatbot.cli"):
            return None
        for finder in sys.meta_path:
            find = None if isinstance(finder, _ShowingFinder) else getattr(finder, "find_spec", None)
            spec: ModuleSpec | None = None if find is None else find(fullname, path, target)
            if spec is not None:
                if spec.loader is not None:
                    spec.loader = _ShowingLoader(spec.loader, self._line)
                return spec
        return None


class _ShowingLoader(Loader):
    """Loads a module by its own loader, which the module then has."""

    def __init__(self, loader: Any, line: _Line) -> None:
        self._loader = loader
        self._line = line

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Create the module."""
        with self._line.shown():
            created: ModuleType | None = self._loader.create_module(spec)
        return created

    def exec_module(self, module: ModuleType) -> None:
        """Execute the module."""
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        with self._line.shown():
            self._loader.exec_module(module)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)
