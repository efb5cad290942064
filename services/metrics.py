"""Prometheus metrics: requests, mapping stages, lost frames, sizes of maps, queues and jobs."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter as Count
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from splatbot.services.bus import Bus
from splatbot.services.jobs import Jobs
from splatbot.services.library import MapLibrary
from splatbot.services.store import MapStore
from splatbot.services.topics import RESULT, map_topic
from splatbot.slam import FrameResult

_REQUEST_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10)
_STAGE_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1)
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"})  # others share one series
_WAITING = 4096  # results that may wait to be counted


class Metrics:
    """One registry: counters of frame results and requests, and gauges that are read on collection.

    Args:
        store: source of the maps, and of the bus that is subscribed to.
        jobs: that are counted.
        library: maps on disk, if they are saved.
    """

    def __init__(self, store: MapStore, jobs: Jobs, library: MapLibrary | None = None) -> None:
        self.registry = CollectorRegistry()
        r = self.registry
        self._requests = Histogram(
            "splatbot_request_seconds", "Requests by route and status", ["method", "route", "status"],
            buckets=_REQUEST_S, registry=r,
        )  # fmt: skip
        self._stages = Histogram(
            "splatbot_frame_stage_seconds", "Stages of the frames", ["stage"], buckets=_STAGE_S, registry=r
        )
        self._frames = Counter("splatbot_frames", "Frames by verdict", ["map", "verdict"], registry=r)
        self._counted: dict[tuple[str, str], None] = {}
        self._store = store
        r.register(_Present(store, jobs, library))
        self._results = store.bus.subscribe(map_topic("*", RESULT), capacity=_WAITING, latched=False)
        self._writer = ThreadPoolExecutor(1, "metrics-text")  # its own: metrics do not wait behind work
        self._thread = threading.Thread(target=self._count_frames, name="metrics", daemon=True)
        self._thread.start()

    def count(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count an answered request."""
        self._requests.labels(method if method in _METHODS else "other", route, str(status)).observe(seconds)

    def text(self) -> bytes:
        """Return all metrics in Prometheus' text format."""
        self._forget_deleted()
        return generate_latest(self.registry)

    async def text_soon(self) -> bytes:
        """Return :meth:`text`, which a thread of its own makes."""
        return await asyncio.get_running_loop().run_in_executor(self._writer, self.text)

    def close(self) -> None:
        """Count no more."""
        self._writer.shutdown(wait=False)
        self._results.close()
        self._thread.join(5)

    def _count_frames(self) -> None:
        for message in self._results:
            result: FrameResult = message.value
            series = message.topic.split("/")[1], result.verdict
            if series not in self._counted:
                self._forget_deleted()
                self._counted[series] = None
            self._frames.labels(*series).inc()
            for stage, ms in result.stage_ms.items():
                self._stages.labels(stage).observe(1e-3 * ms)

    def _forget_deleted(self) -> None:
        """Remove the series of deleted maps."""
        present = {served.id for served in self._store.list()}
        for series in [series for series in tuple(self._counted) if series[0] not in present]:
            self._counted.pop(series, None)
            with suppress(KeyError):
                self._frames.remove(*series)


class _Present(Collector):
    """Gauges that are read when Prometheus collects them."""

    def __init__(self, store: MapStore, jobs: Jobs, library: MapLibrary | None) -> None:
        self._store, self._bus, self._jobs, self._library = store, store.bus, jobs, library

    def collect(self) -> Iterator[Metric]:
        """Collect the metric families."""
        maps = self._store.list()
        families = {
            "gaussians": ("Gaussians in the map", lambda m: m.gaussians),
            "bytes": ("Size of the map", lambda m: m.nbytes),
            "version": ("Published states", lambda m: m.map_version),
        }
        for name, (help_text, value) in families.items():
            family = GaugeMetricFamily(f"splatbot_map_{name}", help_text, labels=["map"])
            for served in maps:
                family.add_metric([served.id], value(served))
            yield family
        if self._library is not None:
            name, help_text = "splatbot_map_save_failures", "Saves of maps that failed"
            yield CounterMetricFamily(name, help_text, value=self._library.failures)
            unsaved = len(self._library.failing)
            yield GaugeMetricFamily("splatbot_maps_unsaved", "Maps whose last save failed", value=unsaved)
        yield _dropped(self._bus)
        yield GaugeMetricFamily("splatbot_bus_readers", "Open subscriptions", value=self._bus.readers)
        family = GaugeMetricFamily("splatbot_jobs", "Jobs by state", labels=["kind", "state"])
        for (kind, state), number in Count((job.kind, job.state) for job in self._jobs.list()).items():
            family.add_metric([kind, state], number)
        yield family


def _dropped(bus: Bus) -> Metric:
    family = CounterMetricFamily("splatbot_bus_dropped", "Messages that readers were too slow for", labels=["topic"])
    kinds: Count[str] = Count()
    for topic, number in bus.dropped.items():
        kinds[_kind(topic)] += number
    for kind, number in kinds.items():
        family.add_metric([kind], number)
    return family


def _kind(topic: str) -> str:
    """Return one name for the topics of all maps, jobs or motions; each of them is short-lived."""
    first, *rest = topic.split("/")
    if first == "maps":
        return f"maps/{rest[-1]}"
    return first if first in ("jobs", "motions") else topic
