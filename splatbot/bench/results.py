"""Rows of measured values, and their files."""

from __future__ import annotations

import csv
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatbot.atomic import atomic_write
from splatbot.errors import InputError

if TYPE_CHECKING:
    from splatbot.bench.timing import Timing


@dataclass(frozen=True)
class Row:
    """One measured value.

    Args:
        case: the measured case, as in "surface 320x240, 2 threads".
        metric: name of the value, as in "forward".
        value: the value. If None, ``note`` gives the reason.
        unit: unit of the value; "x" for a ratio.
        spread: in the same unit; of a time, median minus least of the repeated runs; of a mean, the standard deviation.
        peer: the measured peer, or the reference of the ratio. If None, the value is splatbot's.
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
    """Data of plots that no row holds, as JSON values."""

    def add(
        self,
        case: str,
        metric: str,
        value: float | None,
        unit: str,
        *,
        spread: float | None = None,
        peer: str | None = None,
        note: str | None = None,
    ) -> None:
        """Append one value."""
        self.rows.append(Row(case, metric, value, unit, spread, peer, note))

    def add_time(self, case: str, metric: str, timing: Timing, *, peer: str | None = None) -> None:
        """Append the least time [ms], with the median's distance as its spread."""
        self.rows.append(Row(case, metric, timing.least_ms, "ms", spread=timing.median_ms - timing.least_ms, peer=peer))

    def find(self, case: str, metric: str, peer: str | None = None) -> float | None:
        """Return the value of that case, metric and peer. If None, no such row exists."""
        for row in self.rows:
            if (row.case, row.metric, row.peer) == (case, metric, peer):
                return row.value
        return None

    def select(self, prefix: str) -> list[Row]:
        """Return the rows whose case begins with ``prefix``."""
        return [row for row in self.rows if row.case.startswith(prefix)]

    def write_json(self, path: Path) -> None:
        """Write ``{"machine": {...}, "rows": [{...}]}``, and ``"curves"`` if there are any."""
        values = {"machine": self.machine, "rows": [asdict(row) for row in self.rows]}
        text = json.dumps(values | ({"curves": self.curves} if self.curves else {}), indent=1)
        with atomic_write(path) as file:
            file.write(text.encode())

    @classmethod
    def read_json(cls, path: Path) -> Results:
        """Read results that :meth:`write_json` wrote.

        Raises:
            InputError: the file is missing or has other content.
        """
        try:
            values = json.loads(path.read_text())
            results = cls(values["machine"], [Row(**row) for row in values["rows"]], values.get("curves", {}))
            if not isinstance(results.machine, dict) or not isinstance(results.curves, dict):
                raise ValueError("machine or curves are no objects")
            return results
        except FileNotFoundError:
            hint = "run the benchmark first, or give the folder of its results"
            raise InputError("does not exist.", file=path, field="--out", hint=hint) from None
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"is no file of results ({error}).", file=path, hint="run the benchmark again") from error

    def write_csv(self, path: Path) -> None:
        """Write the rows alone."""
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            names = list(Row.__dataclass_fields__)
            writer.writerow(names)
            writer.writerows([getattr(row, name) for name in names] for row in self.rows)
