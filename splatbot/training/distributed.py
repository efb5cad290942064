"""Training by several processes: each takes a share of the views of a step, and all take the same step.

Every process holds all Gaussians and draws the same random numbers. Gloo sums the gradients of a step over the
processes, and every process then changes its Gaussians by the same bits.
"""

from __future__ import annotations

import io
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from splatbot.errors import InputError
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.helpers import LostProcessError, check_helpers, started_helpers, threads_each

_MOST_PROCESSES = 64  # that one command starts
_VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
_FILE = "file://"  # in place of an address: processes of one machine meet in a file
_LOOPBACK = "lo0" if sys.platform == "darwin" else "lo"
_POLL_S = 0.02
_ENDING_S = 5.0  # until the process at fault has ended


@dataclass(frozen=True)
class TrainingGroup:
    """The processes of a training as one of them sees them; without arguments, a process that trains alone.

    Args:
        rank: number of this process, from 0; process 0 decides and writes.
        size: number of processes.
        local: number of processes of its machine if it is the first of them, else 0.
    """

    rank: int = 0
    size: int = 1
    local: int = 1

    @property
    def leads(self) -> bool:
        """Return whether this process decides and writes."""
        return self.rank == 0

    def share(self, count: int) -> range:
        """Return the share of this process in ``count`` views; the shares of the ranks follow one another."""
        return range(count * self.rank // self.size, count * (self.rank + 1) // self.size)

    def sum(self, *tensors: Tensor) -> None:
        """Replace each contiguous tensor by its sum over the processes; all receive the same bits.

        Raises:
            LostProcessError: a process is gone.
        """
        if self.size > 1:
            with _answering():
                for tensor in tensors:
                    dist.all_reduce(tensor)

    def agree(self, seconds: float, stop: bool) -> tuple[float, bool]:
        """Return the time of process 0 [s], and whether any process wants to stop.

        Raises:
            LostProcessError: a process is gone.
        """
        values = torch.tensor([seconds if self.leads else 0.0, float(stop)], dtype=torch.float64)
        self.sum(values)
        return float(values[0]), bool(values[1] > 0)

    def broadcast(self, state: Mapping[str, Any]) -> dict[str, Any]:
        """Return the state of process 0: tensors and plain values by name; no code is read from it.

        Raises:
            LostProcessError: a process is gone.
        """
        buffer = io.BytesIO()
        torch.save(dict(state), buffer)
        content = torch.frombuffer(buffer.getbuffer(), dtype=torch.uint8)
        length = torch.tensor([len(content)])
        with _answering():
            dist.broadcast(length, 0)
            content = content if self.leads else torch.empty(int(length), dtype=torch.uint8)
            dist.broadcast(content, 0)
        received: dict[str, Any] = torch.load(io.BytesIO(content.numpy().tobytes()), weights_only=True)
        return received


ALONE = TrainingGroup()


def planned_group(processes: int) -> TrainingGroup:
    """Return the group of this process before it is connected: that of torchrun, or one of local processes.

    Args:
        processes: number of processes of this machine, 1 to 64; 1 with torchrun, which has started them.

    Raises:
        InputError: the number is out of range, or torchrun's variables are not those of a process.
    """
    if not 1 <= processes <= _MOST_PROCESSES:
        raise InputError(f"is {processes}.", field="--processes", hint=f"give 1 to {_MOST_PROCESSES}")
    if not _is_member():
        return TrainingGroup(0, processes, processes)
    if processes > 1:
        raise InputError(f"is {processes} under torchrun.", field="--processes", hint="leave it out")
    rank, size = os.environ["RANK"], os.environ["WORLD_SIZE"]
    if not (rank.isdecimal() and size.isdecimal() and int(rank) < int(size)):
        hint = "start the processes by torchrun"
        raise InputError(f"is process {rank!r} of {size!r}.", field="RANK, WORLD_SIZE", hint=hint)
    of_file = os.environ["MASTER_ADDR"].startswith(_FILE)  # the process that started this one counts for it
    first = not of_file and os.environ.get("LOCAL_RANK", "0") == "0"
    return TrainingGroup(int(rank), int(size), int(os.environ.get("LOCAL_WORLD_SIZE", "1")) if first else 0)


@contextmanager
def connected(group: TrainingGroup, settings: TrainingSettings, log: str | None = None) -> Iterator[None]:
    """Return a context in which the processes of a planned group can talk; local ones are started, and end with it.

    Args:
        group: of :func:`planned_group`.
        settings: of the training.
        log: where the recording of a run is now, if it was moved.

    Raises:
        LostProcessError: a process ended early, or does not answer.
        InputError: there are more processes than images in a step.
    """
    batch = settings.options.batch
    if batch < group.size:
        hint = f"use at most {batch} processes, or train again with a larger --batch"
        raise InputError(f"is {batch} images a step for {group.size} processes.", field="--batch", hint=hint)
    if _is_member():
        address, store = os.environ["MASTER_ADDR"], None
        if address.startswith(_FILE):
            store = dist.FileStore(address.removeprefix(_FILE), group.size)
            store.set(str(group.rank), "")
        with _joined(group, store):
            yield
    elif group.size == 1:
        yield
    else:
        with _local(group, settings, log):
            yield


def _is_member() -> bool:
    """Return whether torchrun or another process of this machine started this process as one of a group."""
    return all(name in os.environ for name in _VARIABLES)


@contextmanager
def _local(group: TrainingGroup, settings: TrainingSettings, log: str | None) -> Iterator[None]:
    """Start the other processes on this machine; they meet in a file of a private folder and talk over loopback."""
    size = group.size
    shared = {"GLOO_SOCKET_IFNAME": _LOOPBACK, "SPLATBOT_NUM_THREADS": str(threads_each(size))}
    with TemporaryDirectory(prefix="splatbot-train-") as place, _variables(shared), started_helpers(size) as start:
        TrainingFolder(place).save_settings(settings)
        store = dist.FileStore(f"{place}/store", size)
        store.set("0", "")
        words = ["train", "--resume", place, *(() if log is None else ("--log", log))]
        common = {"WORLD_SIZE": str(size), "MASTER_ADDR": f"{_FILE}{place}/store", "MASTER_PORT": "0"}
        helpers = [
            start(f"process {rank} of {size}", words, Path(place) / f"{rank}.log", {**common, "RANK": str(rank)})
            for rank in range(1, size)
        ]
        while not store.check([str(rank) for rank in range(size)]):
            check_helpers(helpers)
            time.sleep(_POLL_S)
        try:
            with _joined(group, store):
                yield
        except LostProcessError:
            end = time.monotonic() + _ENDING_S
            while time.monotonic() < end:
                check_helpers(helpers)
                time.sleep(_POLL_S)
            raise


@contextmanager
def _joined(group: TrainingGroup, store: dist.Store | None) -> Iterator[None]:
    """Return a context in which this process belongs to a group; without a store, torch's variables name the place."""
    with _answering():
        dist.init_process_group("gloo", store=store, rank=group.rank, world_size=group.size)
    try:
        yield
    finally:
        dist.destroy_process_group()


@contextmanager
def _answering() -> Iterator[None]:
    """Turn an error of the connection in the block into a LostProcessError."""
    try:
        yield
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        hint = "`splatbot train --resume` continues from the last checkpoint"
        raise LostProcessError(f"another process does not answer ({reason}).", field="processes", hint=hint) from error


@contextmanager
def _variables(values: Mapping[str, str]) -> Iterator[None]:
    """Return a context with further environment variables, which libraries read when they start."""
    earlier = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in earlier.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
