"""Rows of the measured costs, the plan of the fleet, and the simulation of a node."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from splatbot.bench.benchmark import ReportProgress
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.sizing import SizingSettings, gigabits
from splatbot.bench.sizing.costs import COLLISIONS, DISTANCE, FRAME, PLACE, PLAN, Costs, read_costs
from splatbot.bench.sizing.fleet import Fleet, FleetPlan, most_robots, plan_fleet, utilisation
from splatbot.bench.sizing.measuring import measure_costs
from splatbot.bench.sizing.queueing import RequestStream, SimulatedNode, simulate_node

_SHARES = (50, 95, 99)
_CURVE = np.geomspace(0.01, 4.0, 60)


def run_sizing(settings: SizingSettings, report_progress: ReportProgress) -> Results:
    """Measure or read the costs, plan the fleet of the settings, and simulate one of its nodes."""
    if settings.costs:
        results, costs = read_costs(settings.costs)
    else:
        report_progress("the peak of this machine")
        results = Results(describe_machine((1,), peak_ms=settings.peak_ms))
        costs = measure_costs(settings, results, report_progress)
        costs.add_to(results)
        settings.save(results)
    fleet = _fleet(settings)
    plan = plan_fleet(costs, fleet)
    _add_plan(results, costs, fleet, plan)
    report_progress(f"simulating {settings.simulated:,} requests of a node, and of a process of each kind")
    node = fleet.robots / plan.nodes
    _add_simulation(results, "node", costs, fleet, fleet.rates, node, fleet.cores, settings.simulated)
    for name, processes, kinds in (
        ("process of a shard", plan.shared_processes, (COLLISIONS, DISTANCE, PLACE)),
        ("process of live maps", plan.live_processes, (FRAME, PLAN)),
    ):
        rates = {kind: fleet.rates[kind] for kind in kinds}
        if any(rates.values()):
            each = math.ceil(fleet.robots / processes)  # whole robots
            _add_simulation(results, name, costs, fleet, rates, each, 1, settings.simulated)
    counts = (_CURVE * fleet.robots).tolist()
    curves = [utilisation(costs, fleet, plan, count) for count in counts]
    results.curves = {"robots": counts, "planned": fleet.robots, "utilisation": curves}
    return results


def _fleet(settings: SizingSettings) -> Fleet:
    half = settings.query_rate / 2
    rates = {FRAME: settings.frame_rate, COLLISIONS: half, DISTANCE: half, PLAN: settings.plan_rate}
    return Fleet(
        gaussians=settings.gaussians,
        robots=settings.robots,
        rates=rates | {PLACE: 1.0 / settings.stay if half else 0.0},
        cores=settings.cores,
        memory=1e9 * settings.memory,
        disk=1e9 * settings.disk,
        read=1e9 * settings.read,
        link=gigabits(settings.link, "--link"),
        balancer=gigabits(settings.balancer, "--balancer"),
        load=settings.load,
        shard=settings.shard,
    )


def _add_plan(results: Results, costs: Costs, fleet: Fleet, plan: FleetPlan) -> None:
    use, most = utilisation(costs, fleet, plan, fleet.robots), most_robots(costs, fleet, plan)
    for metric, value, unit in (
        ("Gaussians", fleet.gaussians, ""),
        ("robots", fleet.robots, ""),
        ("shards", plan.shards, ""),
        ("processes of each shard", plan.replicas, ""),
        ("processes of the shared map", plan.shared_processes, ""),
        ("processes of live maps", plan.live_processes, ""),
        ("nodes", plan.nodes, ""),
        ("balancers", plan.balancers, ""),
        ("memory of a node in use", use["memory"] * fleet.memory / 1e9, "GB"),
        ("disk of a node in use", use["disk"] * fleet.disk / 1e9, "GB"),
    ):
        results.add("plan: fleet", metric, float(value), unit)
    tiles = plan.tiles / 1e6 if plan.tiles else None
    results.add("plan: fleet", "SPLATBOT_TILES_MB", tiles, "MB", note=None if plan.tiles else "the default")
    order = sorted(most, key=lambda name: most[name])
    results.add("plan: fleet", "saturates first", None, "", note=order[0])
    for name in order:
        full = most[name] if np.isfinite(most[name]) else None
        results.add(f"plan: resource {name}", "utilisation", 100 * use[name], "%")
        results.add(f"plan: resource {name}", "robots when full", full, "", note="any number" if full is None else None)


def _add_simulation(
    results: Results,
    name: str,
    costs: Costs,
    fleet: Fleet,
    rates: Mapping[str, float],
    robots: float,
    cores: int,
    count: int,
) -> None:
    """Simulate the requests of some robots on cores behind the link of a node."""
    kinds = [kind for kind, rate in rates.items() if rate]
    streams = [
        RequestStream(
            robots * rates[kind],
            costs.requests[kind].cpu,
            8 * costs.requests[kind].received / fleet.link,
            8 * costs.requests[kind].sent / fleet.link,
        )
        for kind in kinds
    ]
    found = simulate_node(streams, cores, count)
    _add_latencies(results, f"simulated {name}: all", found, sum(stream.rate for stream in streams))
    results.add(f"simulated {name}: all", "cores in use", 100 * found.busy, "%")
    for number, (kind, stream) in enumerate(zip(kinds, streams, strict=True)):
        here = found.kind == number
        part = replace(found, kind=found.kind[here], latency=found.latency[here], wait=found.wait[here])
        _add_latencies(results, f"simulated {name}: {kind}", part, stream.rate)


def _add_latencies(results: Results, case: str, found: SimulatedNode, rate: float) -> None:
    results.add(case, "requests/s", rate, "")
    for share in _SHARES:
        latency = 1e3 * float(np.percentile(found.latency, share)) if len(found.latency) else None
        results.add(case, f"latency p{share}", latency, "ms", note="no request" if latency is None else None)
