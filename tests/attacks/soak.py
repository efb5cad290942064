"""Maps made and deleted, clients coming and going: ``python -m tests.attacks.soak --minutes 30``."""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np
import psutil  # type: ignore[import-untyped]
from websockets.sync.client import connect

from splatbot.client import Client, ServiceError
from splatbot.service_key import key_file, read_key
from splatbot.serving import serving

LOG = "synthetic:tabletop?frames=4&width=80&height=60"
NAMES = ("RSS [MB]", "threads", "file descriptors", "metric series")
SETTLED = 0.45  # share of the run that caches and pools may take to fill; 200 finished jobs are kept


def one_round(url: str, key: str, number: int) -> None:
    """Make a map, ask about it over HTTP and rosbridge, and delete it."""
    with Client(url, key=key) as client:
        name = f"m{number}"
        job = client.create_map(name, LOG)
        with connect(f"{url.replace('http', 'ws')}/rosbridge?api_key={key}", max_size=None) as socket:
            for operation in (
                {"op": "advertise", "topic": f"/t{number}", "type": "std_msgs/msg/String"},
                {"op": "publish", "topic": f"/t{number}", "msg": {"data": "x"}, "latch": True},
                {"op": "subscribe", "topic": "/odom"},
            ):
                socket.send(json.dumps(operation))
            client.wait(job["id"], timeout_s=120)
        client.distance(name, [[0.0, 0.0, 0.8]])
        client.delete_map(name)
        with suppress(ServiceError):
            client.map(name)


def sizes(process: psutil.Process, url: str, key: str) -> tuple[float, ...]:
    """Return the sizes that must not grow, in the order of NAMES."""
    text = httpx.get(f"{url}/metrics", headers={"Authorization": f"Bearer {key}"}, timeout=30).text
    series = sum(not line.startswith("#") for line in text.splitlines())
    return process.memory_info().rss / 2**20, process.num_threads(), process.num_fds(), series


def soak(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and sizes (N, 4) of a run."""
    times, found = [], []
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.txt"
        with serving("--data", f"{folder}/maps", log=log) as service:
            key = str(read_key(key_file()))  # the service made it
            process, begin, number = psutil.Process(service.process.pid), time.monotonic(), 0
            while time.monotonic() - begin < seconds:
                one_round(service.url, key, number)
                number += 1
                times.append(time.monotonic() - begin)
                found.append(sizes(process, service.url, key))
    return np.array(times), np.array(found)


def slopes(times: np.ndarray, found: np.ndarray) -> list[tuple[float, float]]:
    """Return slope and its standard error [1/min] of each size after it has settled."""
    late = times > SETTLED * times[-1]
    t, answers = times[late] / 60, []
    for values in found[late].T:
        if len(t) < 3 or np.ptp(values) == 0:
            answers.append((0.0, 0.0))
            continue
        (slope, _), covariance = np.polyfit(t, values, 1, cov=True)
        answers.append((float(slope), float(np.sqrt(covariance[0, 0]))))
    return answers


def main() -> None:
    """Print each size at the begin and at the end, and its slope."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    times, found = soak(60 * parser.parse_args().minutes)
    print(f"{len(times)} maps made and deleted")
    for name, first, last, (slope, error) in zip(NAMES, found[0], found[-1], slopes(times, found), strict=True):
        print(f"{name}: {first:.0f} -> {last:.0f}, slope {slope:+.2f} +- {error:.2f} a minute")


if __name__ == "__main__":
    main()
