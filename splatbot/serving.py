"""`splatbot serve` as a process of its own, for programs that need a service for a while."""

from __future__ import annotations

import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splatbot.errors import SplatbotError


@dataclass(frozen=True)
class ServingConstants:
    """Constants of a service process."""

    start_timeout: float = 120.0
    """Longest time [s] to start. The service imports torch first."""
    end_timeout: float = 20.0
    """Longest time [s] to end, after which the process is killed."""


CONSTANTS = ServingConstants()


@dataclass(frozen=True)
class Serving:
    """A running service: where it listens, and its process."""

    url: str
    process: subprocess.Popen[str]


@contextmanager
def serving(*arguments: str, log: Path) -> Iterator[Serving]:
    """Run `splatbot serve ARGUMENTS...` on a free port until the block ends.

    Args:
        arguments: of the command, without --port.
        log: file that the service's log goes to.

    Raises:
        SplatbotError: it did not start, or was not ready in time.
    """
    command = [sys.executable, "-P", "-m", "splatbot", "serve", *arguments, "--port", "0"]
    with log.open("w", encoding="utf-8") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            yield Serving(_ready(process, log), process)
        finally:
            process.terminate()
            try:
                process.communicate(timeout=CONSTANTS.end_timeout)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def _ready(process: subprocess.Popen[str], log: Path) -> str:
    """Return the service's URL once it is ready."""
    assert process.stdout is not None
    found = re.search(r"http://[^\s/]+", process.stdout.readline())
    if found is None:
        raise SplatbotError("the service did not start.", file=log, hint="that file says why")
    deadline = time.monotonic() + CONSTANTS.start_timeout
    while time.monotonic() < deadline:
        try:
            with urllib.request.urlopen(f"{found[0]}/readyz", timeout=5):
                return found[0]
        except OSError:
            time.sleep(0.1)
    raise SplatbotError(
        f"the service was not ready within {CONSTANTS.start_timeout:.0f} s.", file=log, hint="that file says why"
    )
