"""The plan of a fleet: shards, processes and nodes that serve its robots at the measured costs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from splatbot.bench.sizing.costs import COLLISIONS, DISTANCE, FRAME, PLACE, PLAN, Costs
from splatbot.errors import InputError

LEAST_REPLICAS = 2
"""Processes of each shard, on different nodes, so that one may fail."""
NODE = ("CPU", "memory", "disk", "disk reads", "link in", "link out")
BALANCER = ("balancer in", "balancer out")
SHARED, LIVE = "processes of the shared map", "processes of live maps"
_OF_SHARED, _OF_LIVE = (COLLISIONS, DISTANCE, PLACE), (FRAME, PLAN)
_FLAGS = {
    COLLISIONS: "--query-rate",
    DISTANCE: "--query-rate",
    PLACE: "--stay",
    FRAME: "--frame-rate",
    PLAN: "--plan-rate",
}


@dataclass(frozen=True)
class Fleet:
    """Robots and machines.

    Args:
        gaussians: of the shared map.
        robots: number of robots.
        rates: requests of a robot by kind [Hz].
        cores, memory, disk, read, link: of a node; [bytes], [bytes/s] and, in each direction, [bit/s].
        balancer: link of a balancer in each direction [bit/s].
        load: share of each resource that a plan uses.
        shard: largest number of Gaussians of a shard.
    """

    gaussians: float
    robots: float
    rates: Mapping[str, float]
    cores: int
    memory: float
    disk: float
    read: float
    link: float
    balancer: float
    load: float
    shard: float


@dataclass(frozen=True)
class FleetPlan:
    """Processes and nodes of a fleet.

    Args:
        shards: parts of the shared map, each a tiled map.
        replicas: processes of each shard.
        live_processes: processes with the maps of single robots.
        tiles: SPLATBOT_TILES_MB of a process of a shard, for its tiles and as much again for its fields [bytes].
        nodes, balancers: number of each.
    """

    shards: int
    replicas: int
    live_processes: int
    tiles: float
    nodes: int
    balancers: int

    @property
    def shared_processes(self) -> int:
        """Processes of all shards."""
        return self.shards * self.replicas


def plan_fleet(costs: Costs, fleet: Fleet) -> FleetPlan:
    """Plan the processes and nodes of a fleet.

    A process counts as one core, because Python runs one thread at a time outside of the kernels. It serves whole
    robots, which are spread evenly over the shards, and those of a shard over its replicas.

    Raises:
        InputError: a robot exceeds a process, or a process exceeds the memory of a node.
    """
    shards = math.ceil(fleet.gaussians / fleet.shard)
    replicas = max(LEAST_REPLICAS, math.ceil(fleet.robots / shards / _robots_each(costs, fleet, *_OF_SHARED)))
    live = math.ceil(fleet.robots / _robots_each(costs, fleet, *_OF_LIVE))
    if any(fleet.rates[kind] for kind in _OF_LIVE):
        live = max(1, live)
    places = math.ceil(fleet.robots / (shards * replicas)) if fleet.rates[PLACE] else 0
    tiles = places * costs.place_cache
    need = (costs.shared_process + 2 * tiles) / fleet.load
    if need > fleet.memory:
        raise InputError("is too small for a process.", field="--memory", hint=f"give {need / 1e9:.3g} GB or more")
    use = utilisation(costs, fleet, FleetPlan(shards, replicas, live, tiles, 1, 1), fleet.robots)
    nodes, balancers = (math.ceil(max(use[name] for name in names) / fleet.load) for names in (NODE, BALANCER))
    return FleetPlan(shards, replicas, live, tiles, max(LEAST_REPLICAS, nodes), max(1, balancers))


def utilisation(costs: Costs, fleet: Fleet, plan: FleetPlan, robots: float) -> dict[str, float]:
    """Return the share of each resource that a number of robots uses on the nodes and processes of a plan.

    The caches of a process keep earlier places, so that they are full at any number of robots.
    """
    requests, rates = costs.requests, fleet.rates
    received = 8 * robots * sum(rate * requests[kind].received for kind, rate in rates.items())
    sent = 8 * robots * sum(rate * requests[kind].sent for kind, rate in rates.items())
    shared = plan.shared_processes * (costs.shared_process + 2 * plan.tiles)
    live = plan.live_processes * costs.live_process
    live += robots * costs.live_map if rates[FRAME] + rates[PLAN] else 0.0
    copies = LEAST_REPLICAS * fleet.gaussians * costs.disk_each
    return {
        "CPU": robots * _cpu(costs, fleet, *rates) / (plan.nodes * fleet.cores),
        "memory": (shared + live) / (plan.nodes * fleet.memory),
        "disk": copies / (plan.nodes * fleet.disk),
        "disk reads": robots * rates[PLACE] * costs.place_tiles / (plan.nodes * fleet.read),
        "link in": received / (plan.nodes * fleet.link),
        "link out": sent / (plan.nodes * fleet.link),
        "balancer in": received / (plan.balancers * fleet.balancer),
        "balancer out": sent / (plan.balancers * fleet.balancer),
        SHARED: robots * _cpu(costs, fleet, *_OF_SHARED) / plan.shared_processes,
        LIVE: robots * _cpu(costs, fleet, *_OF_LIVE) / max(1, plan.live_processes),
    }


def most_robots(costs: Costs, fleet: Fleet, plan: FleetPlan) -> dict[str, float]:
    """Return the number of robots at which each resource of a plan is full; infinite if robots do not use it."""
    base, used = (utilisation(costs, fleet, plan, robots) for robots in (0.0, 1.0))
    most = {
        name: (1.0 - base[name]) / (used[name] - base[name]) if used[name] > base[name] else math.inf for name in base
    }
    whole = replace(fleet, load=1.0)
    most[SHARED] = plan.shared_processes * _robots_each(costs, whole, *_OF_SHARED)
    most[LIVE] = max(1, plan.live_processes) * _robots_each(costs, whole, *_OF_LIVE)
    return most


def _robots_each(costs: Costs, fleet: Fleet, *kinds: str) -> float:
    """Return the number of whole robots whose requests of some kinds one process serves; infinite if they cost nothing.

    Raises:
        InputError: one robot exceeds a process.
    """
    one = _cpu(costs, fleet, *kinds)
    if one > fleet.load:
        costliest = max(kinds, key=lambda kind: _cpu(costs, fleet, kind))
        raise InputError(
            f"makes a robot use {100 * one:.3g} % of a process, at most {100 * fleet.load:.3g} % are allowed.",
            field=_FLAGS[costliest],
            hint="give a longer time" if costliest == PLACE else "give a lower rate",
        )
    return math.floor(fleet.load / one) if one else math.inf


def _cpu(costs: Costs, fleet: Fleet, *kinds: str) -> float:
    """Return the processors that some kinds of requests of a robot use."""
    return sum(fleet.rates[kind] * costs.requests[kind].cpu for kind in kinds)
