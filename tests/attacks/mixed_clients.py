"""Mixed clients while a log is mapped: ``python -m tests.attacks.mixed_clients --seconds 60 --clients 50``."""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil  # type: ignore[import-untyped]
from websockets.sync.client import connect

from splatbot.client import Client
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.service_key import key_file, read_key
from splatbot.serving import Serving, serving

FRAME_S = 0.03  # time between frames [s]
LOG = "synthetic:tabletop?frames=60&width=160&height=120"
MAP = "default"
BASE = {"translation": [0.0, 0.5, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
GOAL = [0.3, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]


@dataclass
class LoadTimes:
    """Measurements of one run.

    Args:
        seconds: times of answers [s].
        statuses: of answers that are not 2xx, and names of errors.
        frames: times of the stages of frames [ms].
        costs: processor time of each kind of request [ms], measured if there are no clients.
    """

    seconds: list[float] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    frames: list[float] = field(default_factory=list)
    costs: dict[str, float] = field(default_factory=dict)

    def p(self, share: float) -> float:
        """Return a quantile of the answers [s]."""
        return float(np.quantile(self.seconds, share)) if self.seconds else 0.0

    def frame_p95(self) -> float:
        """Return the 95 % quantile of frames [ms]."""
        return float(np.quantile(self.frames, 0.95)) if self.frames else 0.0


def requests(http: httpx.Client) -> dict[str, Any]:
    """Return the requests of a client by name, which it sends one after the other."""
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3)).tolist()
    under = "/v1/maps/default"
    return {
        "distance": lambda: http.post(f"{under}/distance", json={"points": points}),
        "collisions": lambda: http.post(f"{under}/collisions", json={"q": [GOAL], "base": BASE}),
        "view": lambda: http.get(f"{under}/render", params={"width": 160, "height": 120}),
        "maps": lambda: http.get("/v1/maps"),
        "healthz": lambda: http.get("/healthz"),
        "IK": lambda: http.post(
            "/v1/ik", json={"pose": {"translation": [0.4, 0.2, 0.4], "quaternion_wxyz": [0, 1, 0, 0]}}
        ),
        "plan": lambda: http.post(f"{under}/plans", json={"goal": GOAL, "base": BASE, "budget_ms": 20}),
    }


def costs(service: Serving, key: str, count: int = 60) -> dict[str, float]:
    """Return the processor time that the service spends on each kind of request [ms], without other load."""
    process, found = psutil.Process(service.process.pid), {}
    with httpx.Client(base_url=service.url, headers={"Authorization": f"Bearer {key}"}, timeout=30) as http:
        for name, send in requests(http).items():
            send()  # builds the field of the map, once
            before = process.cpu_times()
            for _ in range(count):
                send()
            after = process.cpu_times()
            found[name] = 1e3 * (after.user - before.user + after.system - before.system) / count
    return found


def ask(url: str, key: str, until: float, number: int, times: LoadTimes, pause_s: float) -> None:
    """Send requests until a time; repeat a 503 after its Retry-After; a plan without a path is no error."""
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=30) as http:
        todo, at = list(requests(http).values()), number
        while time.monotonic() < until:
            begin = time.perf_counter()
            try:
                response = todo[at % len(todo)]()
            except httpx.HTTPError as error:
                times.statuses[type(error).__name__] += 1
                continue
            times.seconds.append(time.perf_counter() - begin)
            if response.status_code == 503:
                times.statuses["503, asked again"] += 1
                time.sleep(float(response.headers["retry-after"]))
                continue
            if not response.is_success and not (response.status_code == 422 and "code" in response.json()):
                times.statuses[str(response.status_code)] += 1
            at += 1
            time.sleep(pause_s)


def listen(url: str, key: str, until: float, times: LoadTimes) -> None:
    """Read the odometry over rosbridge until a time."""
    with connect(f"{url.replace('http', 'ws')}/rosbridge?api_key={key}", max_size=None) as socket:
        socket.send(json.dumps({"op": "subscribe", "topic": "/odom"}))
        while time.monotonic() < until:
            try:
                socket.recv(timeout=0.5)
            except TimeoutError:
                continue
            except Exception as error:
                times.statuses[f"rosbridge: {type(error).__name__}"] += 1
                return


def push(url: str, key: str, until: float, times: LoadTimes, frames: list[Frame]) -> None:
    """Push frames to and fro until a time, one each FRAME_S or as soon as the one before is mapped."""
    there_and_back = itertools.cycle([*frames, *frames[-2:0:-1]])
    with Client(url, key=key) as robot:
        for number, frame in enumerate(there_and_back):
            begin = time.monotonic()
            if begin >= until:
                return
            pushed = robot.push(MAP, replace(frame, stamp=FRAME_S * (number + 1)))
            times.frames.append(sum(pushed.stage_ms.values()))
            time.sleep(max(0.0, begin + FRAME_S - time.monotonic()))


def measure(seconds: float, clients: int, pause_s: float = 0.5) -> LoadTimes:
    """Serve a map that is made of frames every 30 ms, with a number of clients."""
    times = LoadTimes()
    frames = list(open_log(LOG))
    with tempfile.TemporaryDirectory() as folder, serving("--data", folder, log=Path(folder) / "log.txt") as service:
        key = str(read_key(key_file()))  # the service made it
        with Client(service.url, key=key) as robot:
            robot.create_map(MAP)
            robot.push(MAP, replace(frames[0], stamp=0.0))
        until = time.monotonic() + seconds
        threads = [threading.Thread(target=push, args=(service.url, key, until, times, frames))]
        threads += [
            threading.Thread(target=listen, args=(service.url, key, until, times))
            if number % 10 == 9
            else threading.Thread(target=ask, args=(service.url, key, until, number, times, pause_s))
            for number in range(clients)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(seconds + 60)
        if clients == 0:
            times.costs = costs(service, key)
    return times


def main() -> None:
    """Print errors, times of answers, and times of frames with and without clients."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--pause", type=float, default=0.5, help="of a client between two requests [s]")
    given = parser.parse_args()
    alone, times = measure(min(given.seconds, 20.0), 0), measure(given.seconds, given.clients, given.pause)
    again = times.statuses.pop("503, asked again", 0)
    print(f"{len(times.seconds)} answers, {again} asked again after 503, errors: {dict(times.statuses) or 0}")
    print(f"answers: p50 {1e3 * times.p(0.5):.0f} ms, p99 {1e3 * times.p(0.99):.0f} ms")
    print("processor time of a request:", ", ".join(f"{name} {ms:.1f} ms" for name, ms in alone.costs.items()))
    print(f"frames: p95 {alone.frame_p95():.0f} ms of {len(alone.frames)} alone, ", end="")
    print(f"{times.frame_p95():.0f} ms of {len(times.frames)} with clients")


if __name__ == "__main__":
    main()
