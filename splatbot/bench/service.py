"""What the service costs: questions of many clients while frames are mapped, and HTTP over a call in the process."""

from __future__ import annotations

import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.timing import measure
from splatbot.client import Client, ServiceError
from splatbot.collision import GaussianCollisionField
from splatbot.formats import load_gaussians
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.serving import serving

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


@dataclass
class _Tally:
    """What came back: latencies [s] counted from when each was due, and errors."""

    seconds: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, seconds: float, error: str | None) -> None:
        with self.lock:
            if error is None:
                self.seconds.append(seconds)
            else:
                self.errors.append(error)


def run_service_bench(plan: ServicePlan, folder: Path) -> Results:
    """Measure, and write service.json and service.csv into ``folder``.

    Questions are asked at fixed times whatever the answers take (open loop), so that a slow answer delays no other
    question and its delay is counted. The frames come from a client, as a robot's would.
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
        for name, clients in (("no questions", 0), (f"{plan.clients} clients x {plan.per_s:g}/s", plan.clients)):
            plan.say(f"{name}, {plan.seconds:g} s")
            _measure_case(results, service.url, client, stamps, plan, name, clients)
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


def _push(client: Client, frames: _Stamps, seconds: float) -> tuple[list[float], int]:
    """Milliseconds of each frame's push, and how many were dropped because the one before was not done."""
    begin, ms, dropped = time.perf_counter(), [], 0
    due = begin
    while due < begin + seconds:
        time.sleep(max(0.0, due - time.perf_counter()))
        start = time.perf_counter()
        client.push(_MAP, frames.next())
        ms.append(1e3 * (time.perf_counter() - start))
        due += frames.period
        while due < time.perf_counter():  # a camera does not wait
            due += frames.period
            dropped += 1
    return ms, dropped


def _measure_case(
    results: Results, url: str, client: Client, frames: _Stamps, plan: ServicePlan, name: str, clients: int
) -> None:
    tally, end = _Tally(), time.perf_counter() + plan.seconds
    askers = [threading.Thread(target=_ask, args=(url, plan, tally, i, end)) for i in range(clients)]
    for asker in askers:
        asker.start()
    ms, dropped = _push(client, frames, plan.seconds)
    for asker in askers:
        asker.join()
    results.add(name, "frames", len(ms), "")
    results.add(name, "frame p50", float(np.percentile(ms, 50)), "ms")
    results.add(name, "frame p95", float(np.percentile(ms, 95)), "ms")
    results.add(name, "dropped", dropped, "")
    if clients:
        waits = 1e3 * np.array(tally.seconds or [np.nan])
        results.add(name, "questions", len(tally.seconds), "")
        results.add(name, "errors", len(tally.errors), "", note=tally.errors[0] if tally.errors else None)
        for share in (50, 95, 99, 100):
            results.add(name, f"answer p{share}", float(np.percentile(waits, share)), "ms")


def _ask(url: str, plan: ServicePlan, tally: _Tally, number: int, end: float) -> None:
    rng = np.random.default_rng(number)
    points = rng.uniform((-0.5, -0.5, 0.2), (0.5, 0.5, 1.5), (plan.points, 3))
    due = time.perf_counter() + rng.uniform(0, 1 / plan.per_s)
    with Client(url, retries=0, timeout_s=30) as client:
        while due < end:
            time.sleep(max(0.0, due - time.perf_counter()))
            try:
                client.distance(_MAP, points)
                tally.add(time.perf_counter() - due, None)
            except ServiceError as error:
                tally.add(0.0, str(error))
            due += 1 / plan.per_s


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
