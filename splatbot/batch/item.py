"""One item of a batch: a command line that runs in its own process, with its output and its record in one folder."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from splatbot.atomic import atomic_write
from splatbot.batch.child import INTERRUPTED
from splatbot.errors import FormatError

RECORD, OUTPUT = "item.json", "item.log"
"""Files of an item in addition to those of its command: the record of its end, and the text that it printed."""

_ATTEMPTS = 2  # at an item whose process gets SIGKILL, as by the kernel when memory is short
_CUT_OFF = (INTERRUPTED, -signal.SIGINT)  # Ctrl-C reaches a process that has not left the group of its supervisor yet
_THREADS = ("SPLATBOT_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


@dataclass(frozen=True)
class BatchItem:
    """A command line to run.

    Args:
        name: name of its folder in the folder of the batch.
        words: command line of ``splatbot`` without ``--out``.
        settings: variables ``SPLATBOT_*`` that configure it, by name.
    """

    name: str
    words: tuple[str, ...]
    settings: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ItemRecord:
    """The end of an item, as its folder keeps it.

    Args:
        words, settings: of the item.
        code: exit code of the command; negative for the number of a signal; None if no process reported it.
        seconds: time of the command [s].
        error: error of the command; it is empty if the item is finished.
    """

    words: tuple[str, ...]
    settings: Mapping[str, str]
    code: int | None
    seconds: float
    error: str

    @property
    def finished(self) -> bool:
        """Return whether the command succeeded."""
        return self.code == 0

    def save(self, folder: Path) -> None:
        """Write the record whole or not at all."""
        with atomic_write(folder / RECORD) as file:
            file.write((json.dumps(asdict(self), indent=1) + "\n").encode())


def load_record(folder: Path) -> ItemRecord | None:
    """Load the record of an item; None if it has not ended yet.

    Raises:
        FormatError: the file is damaged.
    """
    path = folder / RECORD
    try:
        values = json.loads(path.read_bytes())
        return ItemRecord(**values | {"words": tuple(values["words"])})
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError) as error:
        raise FormatError(
            f"is damaged ({error}).", file=path, hint="delete it, and its item is computed again"
        ) from error


def run_item(item: BatchItem, batch: Path, place: Path, threads: int, leash: int) -> ItemRecord:
    """Run an item in its own process and save the record of its end.

    The process ends early when the last writer of the leash closes it; such an item gets no record.

    Args:
        item: item to run.
        batch: folder of the batch; the command writes into the folder of that name in it.
        place: current folder of the command, where relative paths begin.
        threads: number of threads of the command.
        leash: descriptor of the reading end of a pipe.
    """
    folder = batch / item.name
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-P", "-m", "splatbot.batch.child", *item.words, "--out", str(folder)]
    environment = {**os.environ, **item.settings, **dict.fromkeys(_THREADS, str(threads)), "PYTHONUNBUFFERED": "1"}
    with (folder / OUTPUT).open("ab") as output:
        # The process inherits the lock: a second one waits until that of a supervisor which was killed has ended.
        fcntl.flock(output, fcntl.LOCK_EX)
        earlier = load_record(folder)
        if earlier is not None and earlier.finished:
            return earlier
        for _ in range(_ATTEMPTS):
            _clear(folder)
            output.truncate(0)
            started = time.monotonic()
            code = subprocess.run(
                command, stdin=leash, stdout=output, stderr=output, env=environment, cwd=place, process_group=0
            ).returncode
            if code != -signal.SIGKILL:
                break
    error = "" if code == 0 else _error(code, folder / OUTPUT)
    record = ItemRecord(item.words, item.settings, code, round(time.monotonic() - started, 3), error)
    if code not in _CUT_OFF:
        record.save(folder)
    return record


def _clear(folder: Path) -> None:
    """Remove the files of an attempt that did not finish."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != OUTPUT:
            path.unlink()


def _error(code: int, output: Path) -> str:
    """Return the error of a command that failed: its last line from "error:" on, or the signal that ended it."""
    if code < 0:
        hint = " The kernel does so when memory is short: use fewer workers." if code == -signal.SIGKILL else ""
        return f"ended by {signal.Signals(-code).name}.{hint}"
    text = output.read_text(encoding="utf-8", errors="replace").strip()
    last = next((line for line in reversed(text.splitlines()) if line.startswith("error: ")), "")
    return last.removeprefix("error: ") or next(reversed(text.splitlines()), f"exit code {code}")
