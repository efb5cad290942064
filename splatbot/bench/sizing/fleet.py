"""The plan of a fleet: shards, processes and nodes that serve its robots at the measured costs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from splatbot.bench.sizing.costs import COLLISIONS, DISTANCE, FRAME, PLACE, PLAN, Costs
from splatbot.errors import InputError

LEAST_REPLICAS = 2
"""Processes of each shard, on different nodes, so that one may fail."""
NODE = ("CPU", "memory", "disk", "disk reads", "link in", "link out")
BALANCER = ("balancer in", "balancer out")


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
        tiles: memory of tiles and fields of a process of a shard [bytes].
        nodes, balancers: number of each.
    """

    shards: int
    replicas: int
    live_processes: int
    tiles: float
    nodes: int
    balancers: int


def plan_fleet(costs: Costs, fleet: Fleet) -> FleetPlan:
    """Plan the processes and nodes of a fleet.

    A process counts as one core, because Python runs one thread at a time outside of the kernels. Robots are spread
    evenly over the shards, and those of a shard over its replicas.

    Raises:
        InputError: one process does not fit into the memory of a node.
    """
    shards = math.ceil(fleet.gaussians / fleet.shard)
    queries = fleet.robots * _cpu(costs, fleet, COLLISIONS, DISTANCE, PLACE)
    replicas = max(LEAST_REPLICAS, math.ceil(queries / shards / fleet.load))
    live = math.ceil(fleet.robots * _cpu(costs, fleet, FRAME, PLAN) / fleet.load)
    tiles = math.ceil(fleet.robots / (shards * replicas)) * costs.place_memory
    if costs.shared_process + tiles > fleet.load * fleet.memory:
        need = (costs.shared_process + tiles) / fleet.load / 1e9
        raise InputError("is too small for a process.", field="--memory", hint=f"give {need:.3g} GB or more")
    use = utilisation(costs, fleet, FleetPlan(shards, replicas, live, tiles, 1, 1), fleet.robots)
    nodes, balancers = (math.ceil(max(use[name] for name in names) / fleet.load) for names in (NODE, BALANCER))
    return FleetPlan(shards, replicas, live, tiles, max(LEAST_REPLICAS, nodes), balancers)


def utilisation(costs: Costs, fleet: Fleet, plan: FleetPlan, robots: float) -> dict[str, float]:
    """Return the share of each resource that a number of robots uses on the nodes and processes of a plan."""
    requests, rates = costs.requests, fleet.rates
    received = 8 * robots * sum(rate * requests[kind].received for kind, rate in rates.items())
    sent = 8 * robots * sum(rate * requests[kind].sent for kind, rate in rates.items())
    processes = plan.shards * plan.replicas * costs.shared_process + plan.live_processes * costs.live_process
    live = costs.live_map if rates[FRAME] + rates[PLAN] else 0.0
    copies = LEAST_REPLICAS * fleet.gaussians * costs.disk_each
    return {
        "CPU": robots * _cpu(costs, fleet, *rates) / (plan.nodes * fleet.cores),
        "memory": (processes + robots * (costs.place_memory + live)) / (plan.nodes * fleet.memory),
        "disk": copies / (plan.nodes * fleet.disk),
        "disk reads": robots * rates[PLACE] * costs.place_read / (plan.nodes * fleet.read),
        "link in": received / (plan.nodes * fleet.link),
        "link out": sent / (plan.nodes * fleet.link),
        "balancer in": received / (plan.balancers * fleet.balancer),
        "balancer out": sent / (plan.balancers * fleet.balancer),
    }


def most_robots(costs: Costs, fleet: Fleet, plan: FleetPlan) -> dict[str, float]:
    """Return the number of robots at which each resource of a plan is full; infinite if robots do not use it."""
    base, used = (utilisation(costs, fleet, plan, robots) for robots in (0.0, 1.0))
    return {
        name: (1.0 - base[name]) / (used[name] - base[name]) if used[name] > base[name] else math.inf for name in base
    }


def _cpu(costs: Costs, fleet: Fleet, *kinds: str) -> float:
    """Return the processors that some kinds of requests of a robot use."""
    return sum(fleet.rates[kind] * costs.requests[kind].cpu for kind in kinds)
