"""A simulated node: requests that wait for its link, then for one of its cores, then for the link of the answers."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RequestStream:
    """Requests of one kind, which arrive at random times (Poisson).

    Args:
        rate: requests a second.
        service: mean time of a core [s]; times are exponential.
        received, sent: time of the link for the request and for the answer [s].
    """

    rate: float
    service: float
    received: float = 0.0
    sent: float = 0.0


@dataclass(frozen=True)
class SimulatedNode:
    """Outcome of a simulation.

    Args:
        kind: (N,) number of the stream of each request.
        latency: (N,) time from the arrival to the end of the answer [s].
        wait: (N,) time for which it waits for a core [s].
        busy: share of the time of the cores in use.
    """

    kind: NDArray[np.int64]
    latency: Array
    wait: Array
    busy: float


def simulate_node(streams: Sequence[RequestStream], cores: int, count: int, seed: int = 0) -> SimulatedNode:
    """Simulate requests of one node.

    Links and cores serve in the order of arrival. A request starts when it has arrived and the resource is free (Kiefer
    and Wolfowitz 1955).

    Args:
        streams: kinds of requests.
        cores: number of cores.
        count: number of requests; the first tenth fills the node and is not reported.
        seed: of arrivals and times.
    """
    rng = np.random.default_rng(seed)
    rates = np.array([stream.rate for stream in streams])
    arrival = np.cumsum(rng.exponential(1.0 / rates.sum(), count))
    kind = rng.choice(len(streams), count, p=rates / rates.sum())
    service = rng.exponential(1.0, count) * np.array([stream.service for stream in streams])[kind]
    ready = _through_link(arrival, np.array([stream.received for stream in streams])[kind])
    start = _starts(ready, service, cores)
    done = _through_link(start + service, np.array([stream.sent for stream in streams])[kind])
    steady = slice(count // 10, None)
    busy = float(service.sum() / (cores * (start + service).max()))
    return SimulatedNode(kind[steady], (done - arrival)[steady], (start - ready)[steady], busy)


def _through_link(arrival: Array, time: Array) -> Array:
    """Return the times at which transfers end; a link serves one after the other."""
    order = np.argsort(arrival, kind="stable")
    # end_i = max(arrival_i, end_(i-1)) + time_i, in closed form
    total = np.cumsum(time[order])
    end = total + np.maximum.accumulate(arrival[order] - (total - time[order]))
    ends = np.empty_like(end)
    ends[order] = end
    return ends


def _starts(ready: Array, service: Array, cores: int) -> Array:
    """Return the times at which requests, sorted by ``ready``, get a core."""
    free = [0.0] * cores
    starts = np.empty(len(ready))
    for number, (at, time) in enumerate(zip(ready.tolist(), service.tolist(), strict=True)):
        start = max(at, free[0])
        heapq.heapreplace(free, start + time)
        starts[number] = start
    return starts
