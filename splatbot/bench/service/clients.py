"""Clients that send queries to a service at fixed times, in a separate process, so that its CPU time is separate too.

``python -m splatbot.bench.service.clients`` reads a :class:`QueryLoad` as JSON and writes a :class:`QueryOutcome`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass

import numpy as np

from splatbot.client import Client, ServiceError
from splatbot.errors import SplatbotError

_NICENESS = 19  # on a robot, clients are other machines: they should not compete with the service for CPUs


@dataclass(frozen=True)
class QueryLoad:
    """Load of queries.

    Args:
        url: URL of the service.
        map_id: The queried map.
        clients: Number of clients. Each queries the distance of ``points`` points ``per_s`` times a second.
        seconds: Duration [s].
    """

    url: str
    map_id: str
    clients: int
    per_s: float
    points: int
    seconds: float


@dataclass(frozen=True)
class QueryOutcome:
    """Answers to the queries.

    Args:
        seconds: Latencies of the answers [s] since the due time of each query.
        errors: Messages of the failed queries.
        cpu_s: Processor time of the clients [s].
    """

    seconds: list[float]
    errors: list[str]
    cpu_s: float

    def and_then(self, more: QueryOutcome) -> QueryOutcome:
        """Return the outcome of both loads."""
        return QueryOutcome(self.seconds + more.seconds, self.errors + more.errors, self.cpu_s + more.cpu_s)


class RunningClients:
    """Clients that run in another process."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def result(self) -> QueryOutcome:
        """Wait for the clients, and return their outcome.

        Raises:
            SplatbotError: The clients failed.
        """
        output, _ = self._process.communicate()
        if self._process.returncode != 0:
            raise SplatbotError("the clients failed.", field="clients", hint="their messages are above")
        return QueryOutcome(**json.loads(output))


@contextmanager
def running_clients(load: QueryLoad) -> Iterator[RunningClients]:
    """Run clients during the block, which begins when they are ready."""
    command = [sys.executable, "-m", "splatbot.bench.service.clients", json.dumps(asdict(load))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield RunningClients(process)
    finally:
        process.kill()
        process.wait()


def send_queries(load: QueryLoad) -> QueryOutcome:
    """Send queries at fixed times (open loop): a late answer delays no other query."""
    seconds: list[float] = []
    errors: list[str] = []
    begin, end = time.process_time(), time.perf_counter() + load.seconds
    threads = [
        threading.Thread(target=_run_client, args=(load, number, end, seconds, errors))
        for number in range(load.clients)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return QueryOutcome(seconds, errors, time.process_time() - begin)


def _run_client(load: QueryLoad, number: int, end: float, seconds: list[float], errors: list[str]) -> None:
    rng = np.random.default_rng(number)
    points = rng.uniform((-0.5, -0.5, 0.2), (0.5, 0.5, 1.5), (load.points, 3))
    due = time.perf_counter() + rng.uniform(0, 1 / load.per_s)
    with Client(load.url, retries=0, timeout_s=30) as client:
        while due < end:
            time.sleep(max(0.0, due - time.perf_counter()))
            try:
                client.distance(load.map_id, points)
                seconds.append(time.perf_counter() - due)
            except ServiceError as error:
                errors.append(str(error))
            due += 1 / load.per_s


def main() -> None:
    """Send the load that the first argument defines."""
    load = QueryLoad(**json.loads(sys.argv[1]))
    with suppress(OSError, AttributeError):
        os.nice(_NICENESS)
    print("ready", flush=True)
    print(json.dumps(asdict(send_queries(load))))


if __name__ == "__main__":
    main()
