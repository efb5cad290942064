"""Recordings that a YAML file lists, each with a path relative to the file and a time offset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from splatbot.errors import LogError
from splatbot.logs.base import Log
from splatbot.trajectory import Trajectory

MAX_OFFSET_S = 1e6
"""Largest time offset [s] of a recording."""

Opener = Callable[[str, str | None], Log]
"""Opens a recording: its address, and the file with its intrinsics or None."""


def stamps_of(log: Log) -> list[float]:
    """Return the stamps of the frames [s]; a recording that does not know them is decoded."""
    known: list[float] | None = getattr(log, "stamps", None)
    return [frame.stamp for frame in log] if known is None else known


def truth_of(log: Log, time_offset: float) -> Trajectory | None:
    """Return the reference poses of a recording whose stamps are ``time_offset`` [s] later in the list."""
    truth = log.ground_truth
    return truth if truth is None or not time_offset else replace(truth, stamps=truth.stamps + time_offset)


def local_address(file: Path, address: str) -> str:
    """Return an address, or the path of a file or folder relative to the one that lists it."""
    local = file.parent / address
    path, mark, options = str(local).partition("?")
    return path + mark + options if Path(path).exists() or local.exists() else address


def check_time_offset(file: Path, where: str, offset: object) -> None:
    """Check a time offset [s] of an entry.

    Raises:
        LogError: it is no number, or too large.
    """
    if isinstance(offset, bool) or not isinstance(offset, int | float) or not abs(offset) <= MAX_OFFSET_S:
        raise LogError(f"is {offset!r:.40}.", file=file, field=f"{where}.time_offset", hint="give seconds")
