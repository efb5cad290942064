"""Rows of figures, and the files they are kept in."""

from __future__ import annotations

import csv
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatbot.atomic import atomic_write

if TYPE_CHECKING:
    from splatbot.bench.timing import Timing


@dataclass(frozen=True)
class Row:
    """One figure.

    Args:
        case: what was run, as in "surface 320x240, 2 threads".
        metric: what was measured, as in "forward".
        value: the figure; None where there is none, with ``note`` saying why.
        unit: of the figure; "x" for a ratio.
        spread: median minus least of the repeated runs, in the same unit.
        peer: whose figure it is, or whom the ratio is against; None: splatbot's own.
    """

    case: str
    metric: str
    value: float | None
    unit: str
    spread: float | None = None
    peer: str | None = None
    note: str | None = None


@dataclass
class Results:
    """All rows of a benchmark with the machine they were measured on."""

    machine: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    curves: dict[str, Any] = field(default_factory=dict)
    """Data of plots that no row holds; they are not written."""

    def add(
        self,
        case: str,
        metric: str,
        value: float | None,
        unit: str,
        *,
        peer: str | None = None,
        note: str | None = None,
    ) -> None:
        """Append one figure."""
        self.rows.append(Row(case, metric, value, unit, peer=peer, note=note))

    def add_time(self, case: str, metric: str, timing: Timing, *, peer: str | None = None) -> None:
        """Append the least time [ms], with the median's distance as its spread."""
        self.rows.append(Row(case, metric, timing.least_ms, "ms", spread=timing.median_ms - timing.least_ms, peer=peer))

    def find(self, case: str, metric: str, peer: str | None = None) -> float | None:
        """The figure of that name, None if there is none."""
        for row in self.rows:
            if (row.case, row.metric, row.peer) == (case, metric, peer):
                return row.value
        return None

    def select(self, prefix: str) -> list[Row]:
        """Rows whose case begins so."""
        return [row for row in self.rows if row.case.startswith(prefix)]

    def write_json(self, path: Path) -> None:
        """``{"machine": {...}, "rows": [{...}]}``."""
        text = json.dumps({"machine": self.machine, "rows": [asdict(row) for row in self.rows]}, indent=1)
        with atomic_write(path) as file:
            file.write(text.encode())

    def write_csv(self, path: Path) -> None:
        """The rows alone."""
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            names = list(Row.__dataclass_fields__)
            writer.writerow(names)
            writer.writerows([getattr(row, name) for name in names] for row in self.rows)
