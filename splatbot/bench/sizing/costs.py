"""Measured costs of the service."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatbot.bench.results import Results, Row
from splatbot.errors import FormatError

FRAME, COLLISIONS, DISTANCE, PLAN = KINDS = ("frame", "collisions", "distance", "plan")
PLACE = "new place"
_CPU, _IN, _OUT = "CPU", "request", "answer"
_MACHINE = ("cpu", "cpus", "load_1min", "isa", "fma_peak_gflops")
_SINGLE = {
    "place_tiles": (PLACE, "tiles", "MB", 1e6),
    "place_fields": (PLACE, "fields", "MB", 1e6),
    "disk_each": ("Gaussian", "disk", "byte", 1.0),
    "shared_process": ("process of the shared map", "memory", "MB", 1e6),
    "live_process": ("process of live maps", "memory", "MB", 1e6),
    "live_map": ("live map", "memory", "MB", 1e6),
}


@dataclass(frozen=True)
class RequestCost:
    """Cost of one request.

    Args:
        cpu: processor time of the service [s].
        received, sent: bodies of the request and of its answer [bytes].
    """

    cpu: float
    received: float
    sent: float


@dataclass(frozen=True)
class Costs:
    """Costs of the service.

    Args:
        requests: by kind: ``KINDS``, and ``PLACE``, the first query at a place of the shared map.
        place_tiles: tiles of a place, which are read from disk and stay in memory [bytes].
        place_fields: collision fields of a place in memory [bytes].
        disk_each: a Gaussian on disk, with its share of the coarser levels and of the index [bytes].
        shared_process: memory of a process of the shared map without places [bytes].
        live_process: memory of a process of live maps without maps [bytes].
        live_map: memory of the map of one robot, with its mapper [bytes].
    """

    requests: Mapping[str, RequestCost]
    place_tiles: float
    place_fields: float
    disk_each: float
    shared_process: float
    live_process: float
    live_map: float

    @property
    def place_cache(self) -> float:
        """Memory of a place in the larger one of the two caches, both of which SPLATBOT_TILES_MB limits [bytes]."""
        return max(self.place_tiles, self.place_fields)

    def add_to(self, results: Results) -> None:
        """Append the costs as rows."""
        for kind, cost in self.requests.items():
            results.add(kind, _CPU, 1e3 * cost.cpu, "ms")
            results.add(kind, _IN, cost.received / 1e3, "kB")
            results.add(kind, _OUT, cost.sent / 1e3, "kB")
        for name, (case, metric, unit, scale) in _SINGLE.items():
            results.add(case, metric, getattr(self, name) / scale, unit)

    @staticmethod
    def of_rows(rows: Sequence[Row], file: Path) -> Costs:
        """Return the costs of rows of :meth:`add_to`.

        Raises:
            FormatError: a cost is missing or negative.
        """
        values = {(row.case, row.metric): row.value for row in rows}

        def value(case: str, metric: str) -> float:
            found = values.get((case, metric))
            if not isinstance(found, int | float) or not 0 <= found < 1e15:
                hint = "give sizing.json of a run without --costs"
                raise FormatError("is missing or no cost.", file=file, field=f"{case}, {metric}", hint=hint)
            return float(found)

        requests = {
            kind: RequestCost(value(kind, _CPU) / 1e3, 1e3 * value(kind, _IN), 1e3 * value(kind, _OUT))
            for kind in (*KINDS, PLACE)
        }
        return Costs(requests, **{name: scale * value(case, m) for name, (case, m, _, scale) in _SINGLE.items()})


def read_measurement(file: Path) -> Results:
    """Read the machine and the rows of an earlier run, without its plan and its simulation.

    Raises:
        FormatError: the file cannot be read, or is not of a benchmark.
    """
    hint = "give sizing.json of a run without --costs"
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        machine, rows = found["machine"], [Row(**row) for row in found["rows"]]
        results = Results({name: machine[name] for name in _MACHINE} | machine)
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=file, hint=hint) from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise FormatError("has no machine and rows of a benchmark.", file=file, hint=hint) from error
    results.rows = [row for row in rows if is_measured(row)]
    return results


def read_costs(file: Path) -> tuple[Results, Costs]:
    """Read the measurement of an earlier run, see :func:`read_measurement`, and its costs."""
    results = read_measurement(file)
    return results, Costs.of_rows(results.rows, file)


def is_measured(row: Row) -> bool:
    """Return whether a row is measured, and not of the plan or of its simulation."""
    return not row.case.startswith(("plan:", "simulated "))
