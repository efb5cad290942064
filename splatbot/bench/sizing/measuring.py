"""Measurement of the costs of the service: two services on this machine, and one client."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from splatbot.bench.benchmark import ReportProgress
from splatbot.bench.results import Results
from splatbot.bench.service.process import cpu_seconds, resident_mib
from splatbot.bench.sizing import SizingSettings
from splatbot.bench.sizing.costs import COLLISIONS, DISTANCE, FRAME, PLACE, PLAN, Costs, RequestCost
from splatbot.client import Client, ServiceError, pack_array
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import SplatbotError
from splatbot.gaussians import GaussianModel
from splatbot.logs import open_log
from splatbot.planning import PlanStatus
from splatbot.robots.panda import panda
from splatbot.services.tiled_fields import field_around
from splatbot.serving import Serving, serving
from splatbot.tiles import TiledMap, write_tiles

Array = NDArray[np.float64]

_EXTENT, _HEIGHT, _ROOM, _SIZE = 20.0, 3.0, 4.0, 0.03  # [m] of a building of 2 million Gaussians, and of a Gaussian
_POINTS, _CONFIGURATIONS = 100, 20  # of a request
_IN_MEMORY = 200_000  # Gaussians of the map in memory
_PLAN_MS, _BASE = 100.0, {"translation": [0.0, 0.5, 0.0]}
_BEFORE_WALL = {"translation": [-0.8, -0.4, 1.0], "quaternion_wxyz": [0.70710678, -0.70710678, 0.0, 0.0]}
_BESIDE_WALL = np.array([1.0, 0.3, 0.0, -1.5, 0.0, 1.9, 0.8])  # [rad] of a Panda; a plan turns it to the other side
_PACKED = {"Content-Type": "application/msgpack", "Accept": "application/msgpack"}
_JSON = {"Content-Type": "application/json"}
_MIB = 2**20


def measure_costs(settings: SizingSettings, results: Results, report_progress: ReportProgress) -> Costs:
    """Measure the costs, and append times of starts and requests to the results.

    Raises:
        SplatbotError: the system does not report memory and processor time, or a service fails.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        report_progress(f"a tiled map of {settings.measured:,} simulated Gaussians")
        model = simulated_building(settings.measured)
        write_tiles(model, folder / "tiles", source="simulated building")
        places = _places(settings)
        place_tiles, place_fields = _measure_places(folder / "tiles", places)
        results.add(
            "Gaussian",
            "memory",
            _memory_each(min(settings.measured, _IN_MEMORY)),
            "byte",
            note="of a map in memory, with its field",
        )
        disk = sum(file.stat().st_size for file in (folder / "tiles").iterdir()) / len(model)
        report_progress("queries of the tiled map")
        requests, shared = _measure_shared(settings, results, folder / "tiles", places)
        report_progress("frames and plans")
        wall().save(folder / "wall.ply")
        more, live, map_bytes = _measure_live(settings, results, folder)
        return Costs({**more, **requests}, place_tiles, place_fields, disk, shared, live, map_bytes)


def building_discs(rng: np.random.Generator, count: int, side: float, size: float) -> tuple[Array, Array]:
    """Draw discs on floors, ceilings and walls of the rooms of a building.

    Args:
        rng: source of random numbers.
        count: number N of discs.
        side: side of the square floor [m].
        size: median standard deviation of the two long axes [m].

    Returns:
        Centres (N, 3) [m] and standard deviations (N, 3) [m] along the axes of the building.
    """
    kind, means = rng.integers(0, 4, count), rng.uniform(0.0, 1.0, (count, 3)) * (side, side, _HEIGHT)
    means[kind == 0, 2], means[kind == 1, 2] = 0.0, _HEIGHT
    for axis, walls in ((0, kind == 2), (1, kind == 3)):
        means[walls, axis] = _ROOM * np.round(means[walls, axis] / _ROOM)
    scales = size * np.exp(rng.normal(0.0, 0.3, (count, 3)))
    scales[np.arange(count), np.array([2, 2, 0, 1])[kind]] = 0.05 * size
    return means, scales


def simulated_building(count: int, seed: int = 0) -> GaussianModel:
    """Return discs on floors, ceilings and walls of rooms, 5,000 of them a square metre of floor."""
    means, scales = building_discs(np.random.default_rng(seed), count, _EXTENT * np.sqrt(count / 2e6), _SIZE)
    model = GaussianModel.from_activated(
        means=means,
        quats=np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)),
        scales=scales,
        opacities=np.full(count, 0.9),
        colors=np.full((count, 3), 0.5),
    )
    return replace(model, observations=model.observations + 9)


def wall() -> GaussianModel:
    """Return a wall of discs, 1 m square, around which the arm plans."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.5, 0.5, 51)] * 2))
    return GaussianModel.from_activated(
        means=np.stack([x, y, np.ones(len(x))], axis=-1),
        quats=np.tile((1.0, 0.0, 0.0, 0.0), (len(x), 1)),
        scales=np.tile((0.015, 0.015, 0.001), (len(x), 1)),
        opacities=np.full(len(x), 0.95),
        colors=np.full((len(x), 3), 0.5),
    )


def plans_around_the_wall(count: int) -> list[dict[str, Any]]:
    """Return requests for plans whose straight line meets the wall, so that each search uses its budget."""
    starts = _BESIDE_WALL + np.random.default_rng(4).uniform(-0.05, 0.05, (count, len(_BESIDE_WALL)))
    goals = starts * np.array([-1.0, *[1.0] * (len(_BESIDE_WALL) - 1)])
    return [
        {"start": start, "goal": goal, "base": _BEFORE_WALL, "budget_ms": _PLAN_MS}
        for start, goal in zip(starts.tolist(), goals.tolist(), strict=True)
    ]


def _memory_each(count: int) -> float:
    """Return the memory of a Gaussian of a map in memory, with its share of the collision field [bytes]."""
    model = simulated_building(count)
    return (model.nbytes + GaussianCollisionField(model).nbytes) / len(model)


def _places(settings: SizingSettings) -> Array:
    """Return places (P, 3) [m] on the floor of the building, the first one for the first query of the process."""
    side = _EXTENT * np.sqrt(settings.measured / 2e6)
    across = np.random.default_rng(1).uniform(0.1 * side, 0.9 * side, (1 + max(3, settings.requests // 4), 2))
    return np.column_stack([across, np.full(len(across), 0.1)])


def _points(place: Array) -> Array:
    return place + np.random.default_rng(2).uniform(-0.4, 0.4, (_POINTS, 3))


def _configurations() -> Array:
    spread = np.random.default_rng(3).uniform(-0.3, 0.3, (_CONFIGURATIONS, 7))
    return np.asarray(panda().home + spread, np.float64)


def _pose(place: Array) -> dict[str, list[float]]:
    return {"translation": place.tolist(), "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}


def _measure_places(folder: Path, places: Array) -> tuple[float, float]:
    """Return the tiles and the fields of a place in memory [bytes], as the routes of the service query them."""
    found = []
    for place in places:
        with TiledMap(folder, memory_mb=1e5) as tiles:
            points, arm = _points(place), _arm(place)
            field_around(tiles, points, "points").mahalanobis(points)
            centres = arm.centers(_configurations()).reshape(-1, 3)
            around = field_around(tiles, centres, "q", room=float(arm.spheres.radii.max()))
            arm.check(around.field, _configurations())
            found.append((tiles.nbytes - tiles.fields.nbytes, tiles.fields.nbytes))
    in_tiles, in_fields = np.mean(found, axis=0)
    return float(in_tiles), float(in_fields)


def _arm(place: Array) -> RobotSpheres:
    T = np.eye(4)
    T[:3, 3] = place
    return RobotSpheres(panda(), T_world_base=T)


def _measure_shared(
    settings: SizingSettings, results: Results, folder: Path, places: Array
) -> tuple[dict[str, RequestCost], float]:
    """Return the costs of queries of a served tiled map, and the memory of its process [bytes]."""
    begin = time.perf_counter()
    log = settings.folder / "shared.log"
    with serving("--map", str(folder), log=log) as service, closing(_CountingClient(service.url)) as client:
        results.add("process of the shared map", "start", time.perf_counter() - begin, "s")
        process_bytes = _resident(service.process)

        def distance(place: Array) -> None:
            _post(client, "distance", {"points": _points(place)})

        def collisions(place: Array) -> None:
            _post(client, "collisions", {"q": _configurations(), "base": _pose(place)})

        def both(place: Array) -> None:
            distance(place)
            collisions(place)

        begin = time.perf_counter()
        distance(places[0])
        results.add("process of the shared map", "first query", 1e3 * (time.perf_counter() - begin), "ms")
        costs = {PLACE: _cost(service, client, results, PLACE, [partial(both, place) for place in places[1:]])}
        for kind, ask in ((DISTANCE, distance), (COLLISIONS, collisions)):
            ask(places[1])
            costs[kind] = _cost(service, client, results, kind, [partial(ask, places[1])] * settings.requests)
        return costs, process_bytes


def _measure_live(
    settings: SizingSettings, results: Results, folder: Path
) -> tuple[dict[str, RequestCost], float, float]:
    """Return the costs of frames and plans, and the memory of the process and of a robot's map [bytes].

    The second of two equal maps gives the memory of a map, for the first one loads libraries too.
    """
    frames = list(open_log(settings.log))
    begin = time.perf_counter()
    log = settings.folder / "live.log"
    given = ("--data", str(folder / "maps"), "--map", str(folder / "wall.ply"))
    with serving(*given, log=log) as service, closing(_CountingClient(service.url)) as client:
        results.add("process of live maps", "start", time.perf_counter() - begin, "s")
        before, costs = [], {}
        for name in ("first", "second"):
            before.append(_resident(service.process))
            client.create_map(name, robot_base=_BASE)
            pushes = [partial(client.push, name, frame) for frame in frames]
            costs[FRAME] = _cost(service, client, results, FRAME, pushes)
        map_bytes = max(0.0, _resident(service.process) - before[1])
        plans = [partial(_plan, client, body) for body in plans_around_the_wall(max(2, settings.requests // 5))]
        costs[PLAN] = _cost(service, client, results, PLAN, plans)
        return costs, before[1] - map_bytes, map_bytes


class _CountingClient(Client):
    """A client that counts the bytes of the bodies that it sends and receives."""

    sent = received = 0

    def request(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[bytes, Mapping[str, str]]:
        self.sent += len(body or b"")
        answer, fields = super().request(method, path, body, headers)
        self.received += len(answer)
        return answer, fields


def _cost(
    service: Serving, client: _CountingClient, results: Results, kind: str, requests: Sequence[Callable[[], object]]
) -> RequestCost:
    """Send requests one after the other, and append their median latency."""
    cpu, sent, received = _cpu(service.process), client.sent, client.received
    seconds = []
    for send in requests:
        begin = time.perf_counter()
        send()
        seconds.append(time.perf_counter() - begin)
    results.add(kind, "latency p50", 1e3 * float(np.median(seconds)), "ms")
    cpu, count = _cpu(service.process) - cpu, len(requests)
    return RequestCost(cpu / count, (client.sent - sent) / count, (client.received - received) / count)


def _post(client: Client, route: str, body: dict[str, Any]) -> None:
    client.request("POST", f"/v1/maps/default/{route}", msgpack.packb(body, default=pack_array), _PACKED)


def _plan(client: Client, body: dict[str, Any]) -> None:
    """Plan; a search that finds no path in its budget costs as much."""
    try:
        client.request("POST", "/v1/maps/default/plans", json.dumps(body).encode(), _JSON)
    except ServiceError as error:
        if error.code != PlanStatus.TIMED_OUT:
            raise


def _resident(process: subprocess.Popen[str]) -> float:
    return _MIB * _known(resident_mib(process))


def _cpu(process: subprocess.Popen[str]) -> float:
    return _known(cpu_seconds(process))


def _known(value: float | None) -> float:
    """Return a figure of the system.

    Raises:
        SplatbotError: the system does not report it.
    """
    if value is None:
        hint = "measure on Linux, or give --costs FILE"
        raise SplatbotError("the system reports no memory and time of processes.", field="/proc", hint=hint)
    return value
