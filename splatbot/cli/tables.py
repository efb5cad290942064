"""Tables on stdout."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

_FILE_WIDTH = 160  # [characters] without a terminal


def print_table(rows: Sequence[tuple[str, str]], *, title: str | None = None) -> None:
    """Print names and values in two columns, plain enough to be piped."""
    if title:
        print(title)
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        print(f"  {name:<{width}}  {value}")


def wide_console() -> Console:
    """Return a console on stdout, as wide as the terminal, or 160 characters wide in a file."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
