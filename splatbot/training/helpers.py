"""Processes that train for this one: each runs a `splatbot` command, and ends with the process that started it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splatbot.batch.workers import usable_cores
from splatbot.errors import InputError, SplatbotError

_ENDING_S = 5.0  # of a helper whose leash is gone; it saves nothing


class LostProcessError(SplatbotError):
    """A process that trains with this one, or for it, is gone."""


@dataclass(frozen=True, eq=False)
class Helper:
    """A process that was started.

    Args:
        name: of the process in messages.
        process: the process.
        output: file of the text that it prints.
    """

    name: str
    process: subprocess.Popen[bytes]
    output: Path

    def failure(self) -> str:
        """Return how the process failed: its error or the signal that ended it; empty while it runs or succeeded."""
        code = self.process.poll()
        if not code:
            return ""
        if code < 0:
            return f"{self.name} was ended by {signal.Signals(-code).name}."
        lines = self.output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = next((line for line in reversed(lines) if line.startswith("error: ")), f"exit code {code}.")
        return f"{self.name}: {last.removeprefix('error: ')}"


Start = Callable[[str, Sequence[str], Path, Mapping[str, str]], Helper]
"""Starts a helper: its name, the words after `splatbot`, the file of its output, and further variables."""


@contextmanager
def started_helpers(at_once: int) -> Iterator[Start]:
    """Yield a function that starts helpers, which share the cores; all end with the block, or with this process.

    Args:
        at_once: number of processes that work at the same time.
    """
    threads = str(threads_each(at_once))
    own = {"SPLATBOT_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, "PYTHONUNBUFFERED": "1"}
    leash, hold = os.pipe()
    helpers: list[Helper] = []

    def start(name: str, words: Sequence[str], output: Path, variables: Mapping[str, str]) -> Helper:
        command = [sys.executable, "-P", "-m", "splatbot.batch.child", *words]
        with output.open("wb") as file:
            process = subprocess.Popen(
                command, stdin=leash, stdout=file, stderr=file, env={**os.environ, **own, **variables}, process_group=0
            )
        helpers.append(Helper(name, process, output))
        return helpers[-1]

    try:
        yield start
    finally:
        os.close(hold)
        for helper in helpers:
            try:
                helper.process.wait(_ENDING_S)
            except subprocess.TimeoutExpired:  # as of a stopped one
                helper.process.kill()
                helper.process.wait()
        os.close(leash)


def check_helpers(helpers: Sequence[Helper], hint: str | None = None) -> None:
    """Check that no helper has failed; a failure that others follow from has priority.

    Args:
        helpers: to check.
        hint: fix of a helper that names none.

    Raises:
        InputError: an input of a helper cannot be used.
        LostProcessError: a helper failed otherwise.
    """
    failed = sorted((helper for helper in helpers if helper.failure()), key=lambda helper: helper.process.poll() == 1)
    if failed:
        message, _, fix = failed[0].failure().partition(" Fix: ")
        wrong_input = failed[0].process.poll() == InputError.exit_code
        raise (InputError if wrong_input else LostProcessError)(message, hint=fix or hint)


def threads_each(at_once: int) -> int:
    """Return the number of threads of each process that works at the same time as others."""
    return max(1, usable_cores() // at_once)
