"""A service in a process of its own, whose memory and health are watched while it is attacked."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from websockets.asyncio.client import connect

from splatbot.services.server import warm_process
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from tests.contracts.conftest import running, wall

MEMORY = 200  # [MB] that an attack may add to the peak
SECONDS = 5.0  # that a refusal may take from the service
LONGEST = 1.0  # [s] of the service that may pass before it answers another client


@dataclass(frozen=True)
class Victim:
    """A running service of another process."""

    client: httpx.Client
    url: str
    pid: int

    def resident(self, kind: str) -> float:
        """Return memory of the process [MB]: "VmRSS" now, "VmHWM" at its peak."""
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(kind)) / 1024

    def clocks(self) -> tuple[float, float]:
        """Return the time [s] and the processor time [s] of the process."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return time.monotonic(), (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def passed(self, begin: tuple[float, float]) -> float:
        """Return the time [s] since earlier readings, by the clock on which less passed: other programs run, too."""
        return min(now - then for now, then in zip(self.clocks(), begin, strict=True))

    def rosbridge(self) -> connect:
        """Connect to rosbridge with the client's key; messages may have any size."""
        url = self.url.replace("http", "ws") + "/rosbridge"
        headers = {name: value for name, value in self.client.headers.items() if name == "authorization"}
        return connect(url, max_size=None, additional_headers=headers)

    @contextmanager
    def attacked(self, *, memory: float = MEMORY, seconds: float = SECONDS) -> Iterator[None]:
        """Check peak memory and duration of the block, and that the service answers meanwhile and afterwards."""
        Path(f"/proc/{self.pid}/clear_refs").write_text("5")  # the peak begins here
        before, ended, waited = self.resident("VmRSS"), threading.Event(), [0.0]

        def watch() -> None:
            with httpx.Client(base_url=self.url, timeout=30) as client:
                while not ended.wait(0.02):
                    begin = self.clocks()
                    assert client.get("/healthz").status_code == 200
                    waited.append(self.passed(begin))

        with ThreadPoolExecutor(1) as pool:
            watcher, begin = pool.submit(watch), self.clocks()
            try:
                yield
            finally:
                took = self.passed(begin)
                ended.set()
        watcher.result()
        grown = self.resident("VmHWM") - before
        p99, most = 1e3 * float(np.quantile(waited, 0.99)), 1e3 * max(waited)
        print(f"took {took:.2f} s, memory +{grown:.0f} MB, healthz p99 {p99:.0f} ms, at most {most:.0f} ms")
        assert grown <= memory
        assert took <= seconds
        assert max(waited) <= LONGEST
        assert self.client.get("/healthz").status_code == 200


@contextmanager
def victim(**settings: Any) -> Iterator[Victim]:
    """Run a service with the map "wall" until the block ends."""
    command = [sys.executable, "-m", "tests.attacks.victim", json.dumps(settings)]
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True)
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            about = json.loads(process.stdout.readline())
            with httpx.Client(base_url=about["url"], headers=about["headers"], timeout=60) as client:
                yield Victim(client, about["url"], process.pid)
        finally:
            process.stdin.close()
            process.wait(60)
            log.seek(0)
            print(log.read())


def _serve() -> None:
    store = MapStore()
    store.add("wall", source="wall.ply", state="static", snapshot=wall())
    warm_process()
    with running(ServiceSettings(**json.loads(sys.argv[1])), store) as service:
        headers = {name: value for name, value in service.client.headers.items() if name in ("authorization",)}
        print(json.dumps({"url": service.url, "headers": headers}), flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    _serve()
