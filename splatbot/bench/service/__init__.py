"""`splatbot bench service`: queries of many clients while frames are mapped, and the overhead of HTTP."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from tyro.conf import Suppress, arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table
from splatbot.errors import InputError


@dataclass(frozen=True)
class ServiceBenchSettings(Settings):
    """Measure the service.

    A client pushes frames at the rate of a camera, first alone, then while other clients query distances of 1,000
    points each at fixed times. The benchmark also measures the overhead of HTTP for a query of 100,000 points.
    The log of the service is written to the output folder.

    Examples:
        splatbot bench service
        splatbot bench service --clients 10 --seconds 20
        splatbot bench service --quick --json figures.json

    Args:
        clients: Number of clients that send queries.
        per_s: Rate of the queries of each client [Hz].
        seconds: Duration of each part [s].
        rate: Rate of the frames [Hz].
        log: Log whose frames are pushed, forwards and backwards in turns.
        points: Points of a query of a client.
        many: Points of the one large query.
    """

    name: ClassVar[str] = "service"
    quick_values: ClassVar[Mapping[str, Any]] = {
        "log": "synthetic:tabletop?frames=6&width=160&height=120&arc=4",
        "rate": 10.0,
        "clients": 3,
        "per_s": 2.0,
        "points": 100,
        "seconds": 2.0,
        "many": 1000,
    }

    clients: Annotated[int, arg(metavar="N")] = 50
    per_s: Annotated[float, arg(metavar="HZ")] = 2.0
    seconds: Annotated[float, arg(metavar="S")] = 60.0
    rate: Annotated[float, arg(metavar="HZ")] = 5.0
    log: Suppress[str] = "synthetic:tabletop?frames=60&width=320&height=240"
    points: Suppress[int] = 1000
    many: Suppress[int] = 100_000

    def validate(self) -> None:
        """Raise an InputError for a number that is not positive."""
        values = {"clients": self.clients, "per-s": self.per_s, "seconds": self.seconds, "rate": self.rate}
        for name, value in values.items():
            if not value > 0:
                raise InputError(f"is {value}.", field=f"--{name}", hint="give a positive number")


def _measure(settings: ServiceBenchSettings, report_progress: ReportProgress) -> Results:
    from splatbot.bench.service.load import run_service_bench

    return run_service_bench(settings, report_progress)


_FRAMES = ("frames", "frame p50", "frame p95", "frame p95 grows by", "dropped")
_PUSHED = ("push to answer p50", "push to answer p95")
_QUERIES = ("queries", "errors", *(f"latency p{share}" for share in (50, 95, 99, 100)))
_CPU = ("CPU of the service", "CPU of the clients", "CPU of the service per answer")

BENCHMARK = Benchmark(
    ServiceBenchSettings,
    _measure,
    tables=(
        Table("Mapped frames", metrics=_FRAMES),
        Table("Frames, from push to answer [ms]", metrics=_PUSHED),
        Table("Queries", metrics=_QUERIES),
        Table("Processor time", metrics=_CPU),
        Table(
            "One large query, and the memory of the service",
            lambda row: row.metric not in (*_FRAMES, *_PUSHED, *_QUERIES, *_CPU),
        ),
    ),
)
