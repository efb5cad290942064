"""What the service costs: questions of many clients while frames are mapped, and HTTP over a call in the process."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.service_clients import Asked, Questions, asking
from splatbot.bench.timing import measure
from splatbot.client import Client
from splatbot.collision import GaussianCollisionField
from splatbot.formats import load_gaussians
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.serving import Serving, serving

_MAP = "live"


@dataclass(frozen=True)
class ServicePlan:
    """What is measured.

    Args:
        log: whose frames are pushed, over and over, forwards and backwards.
        rate: of the frames [Hz].
        clients: that ask, each ``per_s`` times a second for the distance of ``points`` points.
        seconds: with questions, and as long without.
        many: points of the one large question.
        say: told what is measured.
    """

    log: str = "synthetic:tabletop?frames=60&width=320&height=240"
    rate: float = 5.0
    clients: int = 50
    per_s: float = 2.0
    points: int = 1000
    seconds: float = 60.0
    many: int = 100_000
    say: Callable[[str], None] = lambda text: None


def run_service_bench(plan: ServicePlan, folder: Path) -> Results:
    """Measure, and write service.json and service.csv into ``folder``.

    Questions are asked at fixed times whatever the answers take (open loop), so that a slow answer delays no other
    question and its delay is counted. The frames come from a client, as a robot's would; those who ask are a process of
    their own, of the lowest priority: on a robot they are other machines.
    """
    folder.mkdir(parents=True, exist_ok=True)
    results = Results(describe_machine((1,), peak_ms=20.0))
    plan.say("rendering the frames")
    frames = list(open_log(plan.log))
    with (
        tempfile.TemporaryDirectory() as data,
        serving("--data", data, log=folder / "service.log") as service,
        Client(service.url) as client,
    ):
        client.create_map(_MAP)
        stamps = _Stamps(frames, plan.rate)
        _push(client, stamps, 2.0)  # there must be a map to ask about
        before = _resident(service.process)
        plan.say(f"no questions, {plan.seconds:g} s")
        alone = _measure_mapping(results, service, client, stamps, plan, "no questions")
        plan.say(f"questions, {plan.seconds:g} s")
        _measure_questions(results, service, client, stamps, plan, alone)
        results.add("service", "memory before", before, "MiB")
        results.add("service", "memory after", _resident(service.process), "MiB")
        client.end(_MAP)
        _measure_one(results, client, plan)
    results.write_json(folder / "service.json")
    results.write_csv(folder / "service.csv")
    return results


class _Stamps:
    """Frames without end, to and fro, at growing stamps."""

    def __init__(self, frames: Sequence[Frame], rate: float) -> None:
        self._frames = frames
        self.period = 1.0 / rate
        self._number = 0

    def next(self) -> Frame:
        last = max(1, len(self._frames) - 1)
        lap, at = divmod(self._number, last)
        frame = self._frames[last - at if lap % 2 else at]
        self._number += 1
        return replace(frame, stamp=self._number * self.period)


@dataclass(frozen=True)
class _Pushed:
    """What frames took [ms]: the mapper for each, and from pushing it to the answer; and how many were dropped."""

    mapper: list[float]
    answered: list[float]
    dropped: int


def _push(client: Client, frames: _Stamps, seconds: float) -> _Pushed:
    """A frame each period; those are dropped that are due while the one before is not done."""
    begin, mapper, answered, dropped = time.perf_counter(), [], [], 0
    due = begin
    while due < begin + seconds:
        time.sleep(max(0.0, due - time.perf_counter()))
        start = time.perf_counter()
        placed = client.push(_MAP, frames.next())
        answered.append(1e3 * (time.perf_counter() - start))
        mapper.append(sum(placed.stage_ms.values()))
        due += frames.period
        while due < time.perf_counter():  # a camera does not wait
            due += frames.period
            dropped += 1
    return _Pushed(mapper, answered, dropped)


@dataclass(frozen=True)
class _Cost:
    """Of mapping for a while: 95 % of the frames took the mapper ``p95`` [ms] or less; the service ran ``cpu`` [s]."""

    p95: float
    cpu: float | None


def _measure_mapping(
    results: Results, service: Serving, client: Client, frames: _Stamps, plan: ServicePlan, case: str
) -> _Cost:
    before = _cpu_seconds(service.process)
    pushed = _push(client, frames, plan.seconds)
    after = _cpu_seconds(service.process)
    results.add(case, "frames", len(pushed.mapper), "")
    results.add(case, "dropped", pushed.dropped, "")
    for share in (50, 95):
        results.add(case, f"frame p{share}", float(np.percentile(pushed.mapper, share)), "ms")
        results.add(case, f"pushed and answered p{share}", float(np.percentile(pushed.answered, share)), "ms")
    cpu = None if before is None or after is None else after - before
    results.add(case, "service's processors", None if cpu is None else cpu / plan.seconds, "cores")
    return _Cost(float(np.percentile(pushed.mapper, 95)), cpu)


def _measure_questions(
    results: Results, service: Serving, client: Client, frames: _Stamps, plan: ServicePlan, alone: _Cost
) -> None:
    case = f"{plan.clients} clients x {plan.per_s:g}/s"
    with asking(Questions(service.url, _MAP, plan.clients, plan.per_s, plan.points, plan.seconds)) as clients:
        cost = _measure_mapping(results, service, client, frames, plan, case)
        asked = clients.result()
    results.add(case, "frame p95 grows by", 100 * (cost.p95 / alone.p95 - 1), "%")
    _add_answers(results, case, asked)
    results.add(case, "clients' processors", asked.cpu_s / plan.seconds, "cores")
    if cost.cpu is not None and alone.cpu is not None:
        each = 1e3 * (cost.cpu - alone.cpu) / max(1, len(asked.seconds))
        results.add(case, "service's processors for an answer", each, "ms")


def _add_answers(results: Results, case: str, asked: Asked) -> None:
    waits = 1e3 * np.array(asked.seconds or [np.nan])
    results.add(case, "questions", len(asked.seconds), "")
    results.add(case, "errors", len(asked.errors), "", note=asked.errors[0] if asked.errors else None)
    for share in (50, 95, 99, 100):
        results.add(case, f"answer p{share}", float(np.percentile(waits, share)), "ms")


def _measure_one(results: Results, client: Client, plan: ServicePlan) -> None:
    """One large question over HTTP and in this process, on the same map."""
    plan.say(f"{plan.many} points at once")
    while client.map(_MAP)["state"] == "mapping":
        time.sleep(0.1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.ply"
        path.write_bytes(client.request("GET", f"/v1/maps/{_MAP}/splats.ply")[0])
        model = load_gaussians(path)
    points = np.random.default_rng(0).uniform((-0.5, -0.5, 0.2), (0.5, 0.5, 1.5), (plan.many, 3)).astype(np.float32)
    found = GaussianCollisionField(model)
    case = f"{plan.many} points"
    inside = measure(lambda: found.mahalanobis(points), runs=9)
    client.distance_npy(_MAP, points)  # the first question builds the field
    outside = measure(lambda: client.distance_npy(_MAP, points), runs=9)
    results.add_time(case, "in process", inside)
    results.add_time(case, "npy over HTTP", outside)
    results.add(case, "HTTP adds", outside.median_ms - inside.median_ms, "ms")


def _resident(process: subprocess.Popen[str]) -> float | None:
    """Memory of a process [MiB]; None where the system does not tell."""
    try:
        lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS")), None)


def _cpu_seconds(process: subprocess.Popen[str]) -> float | None:
    """Processor time of a process so far [s]; None where the system does not tell."""
    try:
        told = Path(f"/proc/{process.pid}/stat").read_text()
    except OSError:
        return None
    user, system = told.rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
