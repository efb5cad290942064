"""Tables of results for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from rich import table as rich_table
from rich.console import Group, RenderableType

from splatbot.bench.results import Row

Layout = Callable[[str, Sequence[Row], Sequence[str]], RenderableType]


def per_case(title: str, rows: Sequence[Row], metrics: Sequence[str] = ()) -> RenderableType:
    """Lay out a line per case and peer, and a column per metric; without metrics, all that occur.

    A missing value shows its note.
    """
    cases = _grouped(rows)
    metrics = metrics or list(dict.fromkeys(row.metric for row in rows))
    table = rich_table.Table(title=title)
    table.add_column("case")
    for metric in metrics:
        table.add_column(metric, justify="right")
    for case, by_metric in cases.items():
        cells = [value_text(by_metric[metric]) if metric in by_metric else "" for metric in metrics]
        if any(cells):
            table.add_row(case, *cells)
    return table


def per_metric(title: str, rows: Sequence[Row], metrics: Sequence[str] = ()) -> RenderableType:
    """Lay out a line per metric, and a column per case and peer; a missing value shows its note."""
    cases = _grouped(rows)
    table = rich_table.Table("", title=title)
    for case in cases:
        table.add_column(case, justify="right")
    lines: dict[str, dict[str, str]] = {}
    for case, by_metric in cases.items():
        for metric, row in by_metric.items():
            counted = row.unit.startswith("of ")
            text = (row.note or "-") if row.value is None else f"{row.value:.4g}{' ' + row.unit if counted else ''}"
            label = metric if counted or not row.unit else f"{metric} \\[{row.unit}]"
            lines.setdefault(label, {})[case] = text
    for label, texts in lines.items():
        table.add_row(label, *(texts.get(case, "") for case in cases))
    return table


def per_row(title: str, rows: Sequence[Row], metrics: Sequence[str] = ()) -> RenderableType:
    """Lay out a line per row, with its note."""
    table = rich_table.Table("case", "metric", "implementation", "value", "note", title=title)
    for row in rows:
        value = "-" if row.value is None else f"{row.value:.4g} {row.unit}".rstrip()
        table.add_row(row.case, row.metric, row.peer or "splatbot", value, row.note or "")
    return table


def notes_of_peers(title: str, rows: Sequence[Row], metrics: Sequence[str] = ()) -> RenderableType:
    """Lay out one line of text per peer with its note."""
    return Group(*dict.fromkeys(f"{row.peer}: {row.note}" for row in rows if row.note))


@dataclass(frozen=True)
class Table:
    """A table of a benchmark.

    Args:
        title: Title above the table.
        rows: Selects the rows.
        metrics: Columns of :func:`per_case`; if empty, all that occur.
        layout: Arranges the rows.
        split_by: If given, returns the title of the table that a row belongs to. The title is removed from the cases.
    """

    title: str
    rows: Callable[[Row], bool] = lambda row: True
    metrics: Sequence[str] = ()
    layout: Layout = per_case
    split_by: Callable[[Row], str] | None = None

    def render(self, rows: Sequence[Row]) -> list[RenderableType]:
        """Return the tables to print, none without rows."""
        selected = [row for row in rows if self.rows(row) and (not self.metrics or row.metric in self.metrics)]
        if self.split_by is None:
            return [self.layout(self.title, selected, self.metrics)] if selected else []
        parts: dict[str, list[Row]] = {}
        for row in selected:
            title = self.split_by(row)
            parts.setdefault(title, []).append(replace(row, case=row.case.removeprefix(f"{title}, ")))
        return [self.layout(title, part, self.metrics) for title, part in parts.items()]


def cases(*prefixes: str, peers: bool | None = None) -> Callable[[Row], bool]:
    """Select rows whose case begins with one of the prefixes; ``peers`` selects or excludes those of peers."""

    def select(row: Row) -> bool:
        return row.case.startswith(prefixes) and peers in (None, row.peer is not None)

    return select


def value_text(row: Row) -> str:
    """Format a value with its unit; of a time [ms], the least and in parentheses the median."""
    if row.value is None:
        return row.note or "-"
    if row.unit == "ms":
        return f"{row.value:.2f}" + (f" ({row.value + row.spread:.2f})" if row.spread is not None else "")
    return f"{row.value:.3g} {row.unit}".rstrip()


def _grouped(rows: Sequence[Row]) -> dict[str, dict[str, Row]]:
    """Group rows by case and peer, then by metric."""
    groups: dict[str, dict[str, Row]] = {}
    for row in rows:
        groups.setdefault(f"{row.case}: {row.peer}" if row.peer else row.case, {})[row.metric] = row
    return groups
