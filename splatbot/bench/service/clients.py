"""Clients that ask a service at fixed times, in a process of their own: what they cost is told apart from its answers.

``python -m splatbot.bench.service.clients`` reads a :class:`Questions` as JSON and writes an :class:`Asked`.
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

_NICENESS = 19  # other machines' work, which should not compete with the service's


@dataclass(frozen=True)
class Questions:
    """What is asked.

    Args:
        url: of the service.
        map_id: the map.
        clients: that ask, each ``per_s`` times a second for the distance of ``points`` points.
        seconds: how long.
    """

    url: str
    map_id: str
    clients: int
    per_s: float
    points: int
    seconds: float


@dataclass(frozen=True)
class Asked:
    """What came back.

    Args:
        seconds: latencies of the answers [s], counted from when each question was due.
        errors: of the others.
        cpu_s: processor time of the clients [s].
    """

    seconds: list[float]
    errors: list[str]
    cpu_s: float

    def and_then(self, more: Asked) -> Asked:
        """Both together."""
        return Asked(self.seconds + more.seconds, self.errors + more.errors, self.cpu_s + more.cpu_s)


class Asking:
    """Clients at work in another process."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def result(self) -> Asked:
        """What came back, once they have ended.

        Raises:
            SplatbotError: they failed.
        """
        told, _ = self._process.communicate()
        if self._process.returncode != 0:
            raise SplatbotError("the clients failed.", field="clients", hint="their messages are above")
        return Asked(**json.loads(told))


@contextmanager
def asking(questions: Questions) -> Iterator[Asking]:
    """Clients that ask while the block runs; it begins with their first question."""
    command = [sys.executable, "-m", "splatbot.bench.service.clients", json.dumps(asdict(questions))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield Asking(process)
    finally:
        process.kill()
        process.wait()


def ask(questions: Questions) -> Asked:
    """Ask at fixed times whatever the answers take (open loop): a late answer delays no question."""
    seconds: list[float] = []
    errors: list[str] = []
    begin, end = time.process_time(), time.perf_counter() + questions.seconds
    askers = [
        threading.Thread(target=_ask, args=(questions, number, end, seconds, errors))
        for number in range(questions.clients)
    ]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join()
    return Asked(seconds, errors, time.process_time() - begin)


def _ask(questions: Questions, number: int, end: float, seconds: list[float], errors: list[str]) -> None:
    rng = np.random.default_rng(number)
    points = rng.uniform((-0.5, -0.5, 0.2), (0.5, 0.5, 1.5), (questions.points, 3))
    due = time.perf_counter() + rng.uniform(0, 1 / questions.per_s)
    with Client(questions.url, retries=0, timeout_s=30) as client:
        while due < end:
            time.sleep(max(0.0, due - time.perf_counter()))
            try:
                client.distance(questions.map_id, points)
                seconds.append(time.perf_counter() - due)
            except ServiceError as error:
                errors.append(str(error))
            due += 1 / questions.per_s


def main() -> None:
    """Ask as the first argument says."""
    questions = Questions(**json.loads(sys.argv[1]))
    with suppress(OSError, AttributeError):
        os.nice(_NICENESS)
    print("asking", flush=True)
    print(json.dumps(asdict(ask(questions))))


if __name__ == "__main__":
    main()
