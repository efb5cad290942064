"""A real server on a real socket."""

from __future__ import annotations

import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import pose_from_quat
from splatbot.service_key import key_file, read_key
from splatbot.services.app import create_app
from splatbot.services.runtime import Runtime
from splatbot.services.server import Server
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace


@dataclass(frozen=True)
class Service:
    """A running service: its address for clients, its parts, and the key that ``client`` and ``ws`` use, if any."""

    client: httpx.Client
    runtime: Runtime
    app: FastAPI
    url: str
    key: str | None = None

    @property
    def store(self) -> MapStore:
        """Its maps."""
        return self.runtime.store

    def ws(self, path: str) -> str:
        """Return the address of a WebSocket, with the key."""
        query = f"?api_key={self.key}" if self.key else ""
        return f"ws://127.0.0.1:{self.client.base_url.port}{path}{query}"


def generated_requests(service: Service) -> dict[str, Any]:
    """Return the OpenAPI document for schemathesis: JSON bodies alone, no uploads, streams or keys.

    It writes neither npy nor msgpack, and each request of a test has the key.
    """
    document: dict[str, Any] = service.client.get("/openapi.json").json()
    del document["security"]
    del document["paths"]["/v1/maps/{map_id}/upload"]  # takes a zip alone, and has tests of its own
    for path in [path for path in document["paths"] if path.endswith("/events")]:
        del document["paths"][path]  # streams without an end
    for item in document["paths"].values():
        for operation in item.values():
            content = operation.get("requestBody", {}).get("content", {})
            for kind in set(content) - {"application/json"}:
                del content[kind]
    return document


@contextmanager
def running(
    settings: ServiceSettings, store: MapStore | None = None, *, config: Config | None = None
) -> Iterator[Service]:
    """Run a real server on a real socket until the block ends."""
    runtime = Runtime(settings, store, config=config)
    app = create_app(runtime)
    server = Server(runtime, app, [("127.0.0.1", 0)])
    thread = threading.Thread(target=server.run, args=(list(server.listeners),), daemon=True)
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive(), "the server did not start"
            time.sleep(0.01)
        scheme = "http" if settings.tls_cert is None else "https"
        url = f"{scheme}://127.0.0.1:{server.listeners[0].getsockname()[1]}"
        trusted = True if settings.tls_cert is None else ssl.create_default_context(cafile=str(settings.tls_cert))
        key = None if settings.api_keys else read_key(key_file())
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        with httpx.Client(base_url=url, timeout=60, verify=trusted, headers=headers) as client:
            yield Service(client, runtime, app, url, key)
    finally:  # a failed test, too, leaves no server that the next ones share the machine with
        runtime.drain()
        server.should_exit = True
        thread.join(60)
    assert not thread.is_alive(), "the server did not end"


def wall(version: int = 1, *, z: float = 1.0) -> Snapshot:
    """Build a red wall of flat Gaussians, 1 m square at depth ``z`` [m], facing the world's origin."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.5, 0.5, 51), np.linspace(-0.5, 0.5, 51)))
    n = len(x)
    model = GaussianModel.from_activated(
        means=np.stack([x, y, np.full(n, z)], -1),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        scales=np.tile([0.015, 0.015, 0.001], (n, 1)),
        opacities=np.full(n, 0.95),
        colors=np.tile([1.0, 0.2, 0.1], (n, 1)),
    )
    return Snapshot(model, version)


def wall_store() -> MapStore:
    """Return a store with the map "wall"."""
    store = MapStore()
    store.add("wall", source="wall.ply", state="static", snapshot=wall())
    return store


def table_with_box() -> Snapshot:
    """Build a table top at z = 0, z up, and a box of 4 x 6 x 8 cm on it at (0.5, 0, 0)."""
    size = np.array([0.04, 0.06, 0.08])
    grids = [_sheet(np.array([0.5, 0.0, 0.0]), 2, np.array([0.6, 0.8]), 0.02)]
    for axis in range(3):
        for side in (-1, 1):
            center = np.array([0.5, 0.0, 0.04])
            center[axis] += side * size[axis] / 2
            grids.append(_sheet(center, axis, np.delete(size, axis), 0.005))
    means, scales = (np.concatenate(parts) for parts in zip(*grids, strict=True))
    n, table = len(means), len(grids[0][0])
    colors = np.where(np.arange(n)[:, None] < table, [0.5, 0.5, 0.5], [0.9, 0.1, 0.1])
    model = GaussianModel.from_activated(
        means=means, quats=np.tile([1.0, 0, 0, 0], (n, 1)), scales=scales, opacities=np.full(n, 0.95), colors=colors
    )
    model.observations += 9
    return Snapshot(model, 1)


def _sheet(
    center: NDArray[np.float64], axis: int, size: NDArray[np.float64], step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centres and scales of flat Gaussians on a rectangle across an axis."""
    a, b = (np.arange(-s / 2 + step / 2, s / 2, step) for s in size)
    u, v = (g.ravel() for g in np.meshgrid(a, b))
    means = np.tile(center, (len(u), 1))
    others = [k for k in range(3) if k != axis]
    means[:, others[0]] += u
    means[:, others[1]] += v
    scales = np.full((len(u), 3), step / 2)
    scales[:, axis] = 0.0003
    return means, scales


@contextmanager
def serving_wall() -> Iterator[Service]:
    """Run the service on the map "wall", with small limits."""
    store = MapStore()
    beside = Workspace(T_world_base=pose_from_quat((0.0, 0.5, -1.0), (0.7071068, 0.7071068, 0.0, 0.0)))
    store.add("wall", source="wall.ply", state="static", snapshot=wall(), workspace=beside)
    settings = ServiceSettings(
        max_points=1000, max_body_bytes=200_000, max_pixels=640 * 480, max_message_bytes=2_000_000
    )
    with running(settings, store) as it:
        yield it


@pytest.fixture
def service() -> Iterator[Service]:
    """The service on the map "wall", with small limits."""
    with serving_wall() as it:
        yield it
