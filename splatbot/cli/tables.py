"""Tables on stdout."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from splatbot.cli.messages import fitted

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_FILE_WIDTH = 160  # [characters] without a terminal


def print_table(rows: Sequence[tuple[str, str]], *, title: str | None = None) -> None:
    """Print names and values in two columns, plain enough to be piped; a terminal gets values wrapped to its width."""
    if title:
        print(title)
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        first, *rest = fitted(value, sys.stdout, width + 4)
        print(f"  {name:<{width}}  {first}")
        for line in rest:
            print(f"  {'':<{width}}  {line}")


def print_text(text: str) -> None:
    """Print a paragraph: one line in a file; at a terminal, lines that fit it."""
    print("\n".join(fitted(text, sys.stdout)))


def print_command(command: str) -> None:
    """Print the next command, which can be copied: a line that does not fit the terminal is continued."""
    print("next: " + " \\\n    ".join(fitted(command, sys.stdout, len("next:  \\"))))


def wide_console() -> Console:
    """Return a console on stdout, as wide as the terminal, or 160 characters wide in a file."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)


def print_columns(table: Table, console: Console | None = None) -> None:
    """Print a table; one that is wider than the console becomes a record of names and values for each row."""
    console = console or wide_console()
    if _natural_width(table) <= console.width:
        console.print(table)
        return
    if table.title:
        console.print(f"[italic]{table.title}[/italic]", highlight=False)
    names = [str(column.header) for column in table.columns]
    cells = [list(column.cells) for column in table.columns]
    for number in range(table.row_count):
        values = [str(column[number]) for column in cells]
        console.print(f"[bold]{' '.join(part for part in (names[0], values[0]) if part)}[/bold]", highlight=False)
        width = max((len(name) for name in names[1:]), default=0)
        for name, value in zip(names[1:], values[1:], strict=True):
            if value:
                console.print(f"  {name:<{width}}  {value}", highlight=False)


def _natural_width(table: Table) -> int:
    """Return the width [characters] at which no cell wraps; rich measures the table as it would squeeze it."""
    from rich.console import Console
    from rich.measure import Measurement

    wide = Console(width=10_000)
    return Measurement.get(wide, wide.options, table).maximum
