"""`splatbot bench sizing`: measured costs of the service, and the plan and simulation of a fleet from them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import Suppress, arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.sizing.costs import is_measured, read_costs
from splatbot.bench.tables import Table, cases, per_metric
from splatbot.errors import InputError

_LINK = re.compile(r"(\d+(?:\.\d+)?)Gb")


@dataclass(frozen=True)
class SizingSettings(Settings):
    """Measure the costs of the service on this machine, and plan a fleet from them.

    The benchmark runs two services: one of a tiled map, and one that maps pushed frames. It measures the cost of each
    request, place, Gaussian and process. From these costs it plans the processes, shards and nodes of a fleet, and
    simulates the requests of one node. Robots, nodes and the balancer are simulated.

    Examples:
        splatbot bench sizing
        splatbot bench sizing --gaussians 1e9 --robots 1e4
        splatbot bench sizing --costs runs/bench-sizing/sizing.json --robots 200 --link 1Gb

    Args:
        gaussians: Gaussians of the shared map.
        robots: Number of robots.
        query_rate: Collision and distance queries of a robot [Hz], in equal parts.
        plan_rate: Plans of a robot [Hz].
        frame_rate: Frames that a robot pushes into its own map [Hz].
        stay: Time that a robot stays at a place of the shared map [s].
        cores: Cores of a node.
        memory: Memory of a node [GB].
        disk: Disk of a node [GB].
        read: Speed of that disk [GB/s].
        link: Network link of a node, in each direction.
        balancer: Network link of a balancer, in each direction.
        load: Share of each resource that the plan uses.
        shard: Gaussians of one shard of the map, at most 50 million.
        costs: Measured costs of an earlier run (sizing.json), with their machine. If not given, they are measured.
        log: Log whose frames are pushed.
        measured: Gaussians of the served tiled map.
        requests: Number of timed requests of a kind.
        simulated: Number of simulated requests.
    """

    name: ClassVar[str] = "sizing"
    quick_values: ClassVar[Mapping[str, Any]] = {
        "log": "synthetic:tabletop?frames=6&width=160&height=120&arc=4",
        "measured": 20_000,
        "requests": 5,
        "simulated": 5_000,
    }

    gaussians: Annotated[float, arg(metavar="N")] = 1e9
    robots: Annotated[float, arg(metavar="N")] = 1e4
    query_rate: Annotated[float, arg(metavar="HZ")] = 4.0
    plan_rate: Annotated[float, arg(metavar="HZ")] = 0.1
    frame_rate: Annotated[float, arg(metavar="HZ")] = 1.0
    stay: Annotated[float, arg(metavar="S")] = 60.0
    cores: Annotated[int, arg(metavar="N")] = 64
    memory: Annotated[float, arg(metavar="GB")] = 256.0
    disk: Annotated[float, arg(metavar="GB")] = 1000.0
    read: Annotated[float, arg(metavar="GB/S")] = 2.0
    link: Annotated[str, arg(metavar="RATE")] = "10Gb"
    balancer: Annotated[str, arg(metavar="RATE")] = "100Gb"
    load: Annotated[float, arg(metavar="SHARE")] = 0.6
    shard: Annotated[float, arg(metavar="N")] = 2e7
    costs: Annotated[Path | None, arg(metavar="FILE")] = None
    log: Suppress[str] = "synthetic:tabletop?frames=60&width=320&height=240"
    measured: Suppress[int] = 1_000_000
    requests: Suppress[int] = 100
    simulated: Suppress[int] = 200_000

    def validate(self) -> None:
        """Raise an InputError for a value out of range, or for a file without costs."""
        for name in ("gaussians", "robots", "stay", "cores", "memory", "disk", "read"):
            if not 0 < getattr(self, name) <= 1e15:
                raise InputError(f"is {getattr(self, name)}.", field=f"--{name}", hint="give a positive number")
        for name in ("query_rate", "plan_rate", "frame_rate"):
            if not 0 <= getattr(self, name) <= 1e6:
                hint = "give a rate in 0..1e6 Hz"
                raise InputError(f"is {getattr(self, name)}.", field=f"--{name.replace('_', '-')}", hint=hint)
        if not self.query_rate + self.plan_rate + self.frame_rate > 0:
            raise InputError("is 0, as all rates are.", field="--query-rate", hint="give at least one rate")
        if not 0 < self.load < 1:
            raise InputError(f"is {self.load}.", field="--load", hint="give a share between 0 and 1")
        if not 1 <= self.shard <= 5e7:
            raise InputError(f"is {self.shard}.", field="--shard", hint="give at most 5e7, the largest tiled map")
        gigabits(self.link, "--link")
        gigabits(self.balancer, "--balancer")
        if self.costs is not None:
            read_costs(self.costs)


def gigabits(text: str, field: str) -> float:
    """Return the rate of a link [bit/s] of a text as in "10Gb".

    Raises:
        InputError: the text is no rate above 0.
    """
    found = _LINK.fullmatch(text)
    if found is None or float(found[1]) <= 0:
        raise InputError(f"is {text!r}.", field=field, hint="give gigabits a second, as in 10Gb")
    return 1e9 * float(found[1])


def _measure(settings: SizingSettings, report_progress: ReportProgress) -> Results:
    report_progress("loading the libraries")
    from splatbot.bench.sizing.report import run_sizing

    return run_sizing(settings, report_progress)


def _plot(results: Results, folder: Path) -> None:
    from splatbot.bench.sizing.plots import plot_utilisation

    plot_utilisation(results, folder)


BENCHMARK = Benchmark(
    SizingSettings,
    _measure,
    tables=(
        Table("Measured costs", is_measured),
        Table("Plan of the fleet", cases("plan: fleet"), layout=per_metric),
        Table("Plan by resource; the first one saturates first", cases("plan: resource"), split_by=None),
        Table("Simulated requests of a node, and of single processes on one core", cases("simulated")),
    ),
    plot=_plot,
)
