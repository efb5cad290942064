"""What the service costs: questions of many clients while frames are mapped, and HTTP over a call in the process."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.service import ServiceSettings
from splatbot.bench.service.clients import Asked, Questions, asking
from splatbot.bench.timing import measure
from splatbot.client import Client
from splatbot.collision import GaussianCollisionField
from splatbot.formats import load_gaussians
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.serving import Serving, serving

_MAP = "live"
_TURNS = 2


def run_service_bench(settings: ServiceSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Measure, and write service.json and service.csv into ``folder``.

    Questions are asked at fixed times whatever the answers take (open loop), so that a slow answer delays no other
    question and its delay is counted. The frames come from a client, as a robot's would; those who ask are a process of
    their own, of the lowest priority: on a robot they are other machines.
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
        report_progress("mapping all that is to be seen")
        _push(service, client, stamps, min(2 * (len(frames) - 1) / settings.rate, settings.seconds))
        before = _resident(service.process)
        _measure_mapping(results, service, client, stamps, settings, report_progress)
        results.add("service", "memory before", before, "MiB")
        results.add("service", "memory after", _resident(service.process), "MiB")
        client.end(_MAP)
        _measure_one(results, client, settings, report_progress)
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


@dataclass
class _Pushed:
    """What frames took [ms]: the mapper for each, and from pushing it to the answer; how many were dropped; and the
    service's processor time meanwhile [s], None where the system does not tell.
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
    """A frame each period; those are dropped that are due while the one before is not done."""
    found, before = _Pushed(), _cpu_seconds(service.process)
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
    after = _cpu_seconds(service.process)
    found.cpu_s = None if before is None or after is None else after - before
    return found


def _measure_mapping(
    results: Results,
    service: Serving,
    client: Client,
    frames: _Stamps,
    settings: ServiceSettings,
    report_progress: ReportProgress,
) -> None:
    """Without questions and with them by turns: a map grows, and a machine is not as quick at all times."""
    alone, asked_at = _Pushed(), _Pushed()
    asked = Asked([], [], 0.0)
    part = settings.seconds / _TURNS
    for turn in range(_TURNS):
        report_progress(f"no questions, then questions, {part:g} s each ({turn + 1} of {_TURNS})")
        alone.add(_push(service, client, frames, part))
        with asking(Questions(service.url, _MAP, settings.clients, settings.per_s, settings.points, part)) as clients:
            asked_at.add(_push(service, client, frames, part))
            asked = asked.and_then(clients.result())
    case = f"{settings.clients} clients x {settings.per_s:g}/s"
    for name, pushed in (("no questions", alone), (case, asked_at)):
        _add_frames(results, name, pushed, settings.seconds)
    growth = float(np.percentile(asked_at.mapper, 95) / np.percentile(alone.mapper, 95)) - 1
    results.add(case, "frame p95 grows by", 100 * growth, "%")
    _add_answers(results, case, asked)
    results.add(case, "clients' processors", asked.cpu_s / settings.seconds, "cores")
    if asked_at.cpu_s is not None and alone.cpu_s is not None:
        each = 1e3 * (asked_at.cpu_s - alone.cpu_s) / max(1, len(asked.seconds))
        results.add(case, "service's processors for an answer", each, "ms")


def _add_frames(results: Results, case: str, pushed: _Pushed, seconds: float) -> None:
    results.add(case, "frames", len(pushed.mapper), "")
    results.add(case, "dropped", pushed.dropped, "")
    for share in (50, 95):
        results.add(case, f"frame p{share}", float(np.percentile(pushed.mapper, share)), "ms")
        results.add(case, f"pushed and answered p{share}", float(np.percentile(pushed.answered, share)), "ms")
    results.add(case, "service's processors", None if pushed.cpu_s is None else pushed.cpu_s / seconds, "cores")


def _add_answers(results: Results, case: str, asked: Asked) -> None:
    waits = 1e3 * np.array(asked.seconds or [np.nan])
    results.add(case, "questions", len(asked.seconds), "")
    results.add(case, "errors", len(asked.errors), "", note=asked.errors[0] if asked.errors else None)
    for share in (50, 95, 99, 100):
        results.add(case, f"answer p{share}", float(np.percentile(waits, share)), "ms")


def _measure_one(results: Results, client: Client, settings: ServiceSettings, report_progress: ReportProgress) -> None:
    """One large question over HTTP and in this process, on the same map."""
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
