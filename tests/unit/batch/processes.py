"""Processes of items, found by their command lines in /proc."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

LONG = ("simulate", "tabletop", "--frames", "20000", "--size", "64x48")
"""A command that writes frames for minutes."""


def item_processes(folder: Path) -> list[int]:
    """Return the numbers of the running processes of the items of a batch."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            words = (place / "cmdline").read_bytes().decode(errors="replace").split("\0")
        except (FileNotFoundError, ProcessLookupError):
            continue
        if "splatbot.batch.child" in words and any(word.startswith(f"{folder}/") for word in words):
            found.append(int(place.name))
    return found  # a zombie has no command line


def parent_of(process: int) -> int:
    """Return the number of the parent of a process."""
    return int(Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[1])


def wait_until(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    """Wait for a condition, and fail if it does not come true in time."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)
