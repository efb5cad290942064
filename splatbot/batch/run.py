"""A batch: its items run once each, and a second call continues with those that are not finished."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from splatbot.batch.item import OUTPUT, BatchItem, ItemRecord, load_record
from splatbot.batch.workers import Submit
from splatbot.errors import InputError

LOCK = "batch.lock"
OnEnd = Callable[[BatchItem, ItemRecord], None]


@contextmanager
def reserved(batch: Path) -> Iterator[None]:
    """Reserve the folder of a batch for this process during the block; the folder is created.

    Raises:
        InputError: another process has it.
    """
    batch.mkdir(parents=True, exist_ok=True)
    with (batch / LOCK).open("a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            lock.seek(0)
            hint = "wait until it ends, or name another folder"
            raise InputError(
                f"is in use by process {lock.read(20).strip() or '?'}.", file=batch, field="--out", hint=hint
            ) from error
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        yield


def unfinished(items: Sequence[BatchItem], batch: Path) -> list[BatchItem]:
    """Return the items that are still to run.

    Raises:
        InputError: the folder of an item holds the result of another command line, or files of another origin.
        FormatError: a record is damaged.
    """
    return [item for item in items if not _is_finished(item, batch / item.name)]


def _is_finished(item: BatchItem, folder: Path) -> bool:
    record = load_record(folder)
    if record is None:
        if folder.exists() and any(folder.iterdir()) and not (folder / OUTPUT).is_file():
            hint = "name another folder for the batch"
            raise InputError("holds files that no batch wrote.", file=folder, field="--out", hint=hint)
        return False
    if record.finished and (record.words, record.settings) != (item.words, item.settings):
        settings = "".join(f"{name}={value} " for name, value in record.settings.items())
        raise InputError(
            f"holds the result of another command line: {settings}splatbot {' '.join(record.words)}.",
            file=folder,
            field="--out",
            hint="delete it to compute it again, or name another folder for the batch",
        )
    return record.finished


def run_batch(
    items: Sequence[BatchItem], batch: Path, workers: AbstractContextManager[Submit], *, on_end: OnEnd
) -> bool:
    """Run items, and report each as it ends; return whether Ctrl-C ended the batch early.

    Args:
        items: items to run.
        batch: reserved folder of the batch.
        workers: workers that run them.
        on_end: called in this thread with each item and its record.
    """
    try:
        with workers as submit:
            running = {submit(item): item for item in items}
            for future in as_completed(running):
                item = running[future]
                try:
                    record = future.result()
                except Exception as error:  # of a worker that was lost, or that cannot write
                    record = ItemRecord(item.words, item.settings, None, 0.0, f"{type(error).__name__}: {error}")
                    record.save(batch / item.name)
                on_end(item, record)
    except KeyboardInterrupt:
        return True
    return False
