"""Load of the service: queries of many clients while frames are mapped, and HTTP against a call in the process."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.service import ServiceBenchSettings
from splatbot.bench.service.clients import QueryLoad, QueryOutcome, running_clients
from splatbot.bench.service.process import cpu_seconds, resident_mib
from splatbot.bench.timing import measure
from splatbot.client import Client
from splatbot.collision import GaussianCollisionField
from splatbot.formats import load_gaussians
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.serving import Serving, serving

_MAP = "live"
_TURNS = 2


def run_service_bench(settings: ServiceBenchSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Measure the service of the settings, and write its log into their folder.

    Queries are sent at fixed times (open loop), so that a slow answer delays no other query and its delay counts. A
    client pushes the frames, as on a robot. The clients that send queries are a separate process of the lowest
    priority, because on a robot they are other machines.
    """
    results = Results(describe_machine((1,), peak_ms=20.0))
    report_progress("rendering the frames")
    frames = list(open_log(settings.log))
    with (
        tempfile.TemporaryDirectory() as data,
        serving("--data", data, log=settings.folder / "service.log") as service,
        Client(service.url) as client,
    ):
        client.create_map(_MAP)
        stamps = _Stamps(frames, settings.rate)
        report_progress("mapping the whole scene")
        _push(service, client, stamps, min(2 * (len(frames) - 1) / settings.rate, settings.seconds))
        before = resident_mib(service.process)
        _measure_mapping(results, service, client, stamps, settings, report_progress)
        results.add("service", "memory before", before, "MiB")
        results.add("service", "memory after", resident_mib(service.process), "MiB")
        client.end(_MAP)
        _measure_one(results, client, settings, report_progress)
    return results


class _Stamps:
    """An endless sequence of frames, forwards and backwards in turns, with increasing stamps."""

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


@dataclass
class _Pushed:
    """Times of pushed frames.

    Args:
        mapper: Time of the mapper for each frame [ms].
        answered: Time from the push to the answer for each frame [ms].
        dropped: Number of dropped frames.
        cpu_s: Processor time of the service [s]. If None, the system does not report it.
    """

    mapper: list[float] = field(default_factory=list)
    answered: list[float] = field(default_factory=list)
    dropped: int = 0
    cpu_s: float | None = 0.0

    def add(self, more: _Pushed) -> None:
        self.mapper += more.mapper
        self.answered += more.answered
        self.dropped += more.dropped
        self.cpu_s = None if self.cpu_s is None or more.cpu_s is None else self.cpu_s + more.cpu_s


def _push(service: Serving, client: Client, frames: _Stamps, seconds: float) -> _Pushed:
    """Push a frame in each period; frames that are due while the previous one is in progress are dropped."""
    found, before = _Pushed(), cpu_seconds(service.process)
    due = begin = time.perf_counter()
    while due < begin + seconds:
        time.sleep(max(0.0, due - time.perf_counter()))
        start = time.perf_counter()
        placed = client.push(_MAP, frames.next())
        found.answered.append(1e3 * (time.perf_counter() - start))
        found.mapper.append(sum(placed.stage_ms.values()))
        due += frames.period
        while due < time.perf_counter():  # a camera does not wait
            due += frames.period
            found.dropped += 1
    after = cpu_seconds(service.process)
    found.cpu_s = None if before is None or after is None else after - before
    return found


def _measure_mapping(
    results: Results,
    service: Serving,
    client: Client,
    frames: _Stamps,
    settings: ServiceBenchSettings,
    report_progress: ReportProgress,
) -> None:
    """Measure with and without queries in turns, because the map grows and the speed of the machine varies."""
    alone, loaded = _Pushed(), _Pushed()
    outcome = QueryOutcome([], [], 0.0)
    part = settings.seconds / _TURNS
    for turn in range(_TURNS):
        report_progress(f"without and with queries, {part:g} s each ({turn + 1} of {_TURNS})")
        alone.add(_push(service, client, frames, part))
        with running_clients(
            QueryLoad(service.url, _MAP, settings.clients, settings.per_s, settings.points, part)
        ) as clients:
            loaded.add(_push(service, client, frames, part))
            outcome = outcome.and_then(clients.result())
    case = f"{settings.clients} clients x {settings.per_s:g}/s"
    for name, pushed in (("no queries", alone), (case, loaded)):
        _add_frames(results, name, pushed, settings.seconds)
    growth = float(np.percentile(loaded.mapper, 95) / np.percentile(alone.mapper, 95)) - 1
    results.add(case, "frame p95 grows by", 100 * growth, "%")
    _add_answers(results, case, outcome)
    results.add(case, "CPU of the clients", outcome.cpu_s / settings.seconds, "cores")
    if loaded.cpu_s is not None and alone.cpu_s is not None:
        each = 1e3 * (loaded.cpu_s - alone.cpu_s) / max(1, len(outcome.seconds))
        results.add(case, "CPU of the service per answer", each, "ms")


def _add_frames(results: Results, case: str, pushed: _Pushed, seconds: float) -> None:
    results.add(case, "frames", len(pushed.mapper), "")
    results.add(case, "dropped", pushed.dropped, "")
    for share in (50, 95):
        results.add(case, f"frame p{share}", float(np.percentile(pushed.mapper, share)), "ms")
        results.add(case, f"push to answer p{share}", float(np.percentile(pushed.answered, share)), "ms")
    results.add(case, "CPU of the service", None if pushed.cpu_s is None else pushed.cpu_s / seconds, "cores")


def _add_answers(results: Results, case: str, outcome: QueryOutcome) -> None:
    waits = 1e3 * np.array(outcome.seconds or [np.nan])
    results.add(case, "queries", len(outcome.seconds), "")
    results.add(case, "errors", len(outcome.errors), "", note=outcome.errors[0] if outcome.errors else None)
    for share in (50, 95, 99, 100):
        results.add(case, f"latency p{share}", float(np.percentile(waits, share)), "ms")


def _measure_one(
    results: Results, client: Client, settings: ServiceBenchSettings, report_progress: ReportProgress
) -> None:
    """Measure one large query over HTTP and in this process, on the same map."""
    report_progress(f"{settings.many} points at once")
    while client.map(_MAP)["state"] == "mapping":
        time.sleep(0.1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.ply"
        path.write_bytes(client.request("GET", f"/v1/maps/{_MAP}/splats.ply")[0])
        model = load_gaussians(path)
    points = np.random.default_rng(0).uniform((-0.5, -0.5, 0.2), (0.5, 0.5, 1.5), (settings.many, 3)).astype(np.float32)
    found = GaussianCollisionField(model)
    case = f"{settings.many} points"
    inside = measure(lambda: found.mahalanobis(points), runs=9)
    client.distance_npy(_MAP, points)  # the first query builds the field
    outside = measure(lambda: client.distance_npy(_MAP, points), runs=9)
    results.add_time(case, "in process", inside)
    results.add_time(case, "npy over HTTP", outside)
    results.add(case, "HTTP adds", outside.median_ms - inside.median_ms, "ms")
