"""Training by several processes: each takes a share of the views of a step, and all take the same step.

Every process holds all Gaussians and draws the same random numbers. Gloo sums the gradients of a step over the
processes, and every process then changes its Gaussians by the same bits. This needs equal CPUs and software on all
machines: other vector instructions round otherwise. Both are compared at the start, and the number of Gaussians at each
step.
"""

from __future__ import annotations

import atexit
import io
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.native import native
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.helpers import Helper, LostProcessError, check_helpers, started_helpers, threads_each

_MOST_PROCESSES = 64  # that one command starts
_VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
_FILE = "file://"  # in place of an address: processes of one machine meet in a file
_LOOPBACK = "lo0" if sys.platform == "darwin" else "lo"
_CONNECTION = timedelta(seconds=60)  # for processes that are started apart
_ANSWER = timedelta(minutes=10)  # longest wait for a step, a start or scores of another process
_WATCH = timedelta(seconds=0.2)
_POLL_S = 0.02
_ENDING_S = 5.0  # until the process at fault has ended

Watch = Callable[[float], None]
"""Receives how long this process waits for others [s]; an error that it raises ends the wait."""


def _endure(waited_s: float) -> None:
    """Wait on."""


@dataclass(frozen=True)
class TrainingGroup:
    """The processes of a training as one of them sees them; without arguments, a process that trains alone.

    Args:
        rank: number of this process, from 0; process 0 decides and writes.
        size: number of processes.
        local: number of processes of its machine if it is the first of them, else 0.
        watch: called some times a second while this process waits for others.
    """

    rank: int = 0
    size: int = 1
    local: int = 1
    watch: Watch = _endure

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
                    self._finish(dist.all_reduce(tensor, async_op=True))

    def check_count(self, count: int) -> None:
        """Check that all processes have the same number of Gaussians.

        Raises:
            LostProcessError: they do not, or a process is gone.
        """
        if self.size == 1:
            return
        ends = torch.tensor([count, -count])
        with _answering():
            self._finish(dist.all_reduce(ends, dist.ReduceOp.MAX, async_op=True))
        most, least = int(ends[0]), -int(ends[1])
        if least != most:
            hint = "use equal CPUs and software for all processes, and train again"
            raise LostProcessError(f"have {least} to {most} Gaussians in one step.", field="processes", hint=hint)

    def _finish(self, work: dist.Work) -> None:
        """Wait for other processes so that signals are handled meanwhile."""
        began = time.monotonic()
        while True:
            with suppress(RuntimeError):  # not done yet, or failed
                work.wait(_WATCH)
            if work.is_completed():
                break
            self.watch(time.monotonic() - began)
        work.wait()

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
            self._finish(dist.broadcast(length, 0, async_op=True))
            content = content if self.leads else torch.empty(int(length), dtype=torch.uint8)
            self._finish(dist.broadcast(content, 0, async_op=True))
        received: dict[str, Any] = torch.load(io.BytesIO(content.numpy().tobytes()), weights_only=True)
        return received


ALONE = TrainingGroup()


def numerics() -> dict[str, str]:
    """Return the software and the vector instructions that decide how results are rounded."""
    return {
        "torch": str(torch.__version__),
        "CPU of torch": torch.backends.cpu.get_cpu_capability(),
        "kernels": native().isa(),
    }


def check_same(own: Mapping[str, Any], first: Mapping[str, Any]) -> None:
    """Check that a process trains as the first one does.

    Args:
        own: values of this process by name.
        first: those of process 0.

    Raises:
        InputError: a value differs.
    """
    for name, value in first.items():
        if own.get(name) != value:
            message = f"is {own.get(name)} in this process, {value} in process 0."
            hint = "give each process the same command and images, on equal CPUs with the same software"
            raise InputError(message, field=name, hint=hint)


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
def connected(group: TrainingGroup, settings: TrainingSettings, log: str | None = None) -> Iterator[TrainingGroup]:
    """Yield the group while its processes can talk; local ones are started, watched, and end with the block.

    Args:
        group: of :func:`planned_group`.
        settings: of the training.
        log: where the recording of a run is now, if it was moved.

    Raises:
        LostProcessError: a process ended early, or does not answer.
        InputError: there are more processes than images in a step, or an input of a process cannot be used.
    """
    batch = settings.options.batch
    if batch < group.size:
        hint = f"use at most {batch} processes, or train again with a larger --batch"
        raise InputError(f"is {batch} images a step for {group.size} processes.", field="--batch", hint=hint)
    if _is_member():
        address = os.environ["MASTER_ADDR"]
        with _joined(group, address.removeprefix(_FILE) if address.startswith(_FILE) else None):
            yield group
    elif group.size == 1:
        yield group
    else:
        with _local(group, settings, log) as watched:
            yield watched


def _is_member() -> bool:
    """Return whether torchrun or another process of this machine started this process as one of a group."""
    return all(name in os.environ for name in _VARIABLES)


@contextmanager
def _local(group: TrainingGroup, settings: TrainingSettings, log: str | None) -> Iterator[TrainingGroup]:
    """Start the other processes on this machine; they meet in a file of a private folder and talk over loopback."""
    size = group.size
    shared = {"GLOO_SOCKET_IFNAME": _LOOPBACK, "SPLATBOT_NUM_THREADS": str(threads_each(size))}
    with TemporaryDirectory(prefix="splatbot-train-") as place, _variables(shared), started_helpers(size) as start:
        TrainingFolder(place).save_settings(settings)
        words = ["train", "--resume", place, *(() if log is None else ("--log", log))]
        common = {"WORLD_SIZE": str(size), "MASTER_ADDR": f"{_FILE}{place}/store", "MASTER_PORT": "0"}
        helpers = [
            start(f"process {rank} of {size}", words, Path(place) / f"{rank}.log", {**common, "RANK": str(rank)})
            for rank in range(1, size)
        ]

        def watch(waited_s: float) -> None:
            check_helpers(helpers)
            group.watch(waited_s)

        watched = replace(group, watch=watch)
        with _joined(watched, f"{place}/store"):
            try:
                yield watched
            except LostProcessError:
                _await_failure(helpers)
                raise
            finally:
                for helper in helpers:
                    helper.process.kill()  # else torch waits for those that a collective waits for


def _await_failure(helpers: Sequence[Helper]) -> None:
    """Wait for the helper that a collective has lost, and raise its error."""
    end = time.monotonic() + _ENDING_S
    while time.monotonic() < end:
        check_helpers(helpers)
        time.sleep(_POLL_S)


@contextmanager
def _joined(group: TrainingGroup, file: str | None) -> Iterator[None]:
    """Return a context in which this process belongs to a group that meets in a file, or by torch's variables."""
    with _answering():
        _join(group, file)
    leave: Callable[[], object] = dist.destroy_process_group
    try:
        yield
    except KeyboardInterrupt:
        if file is None:  # torch waits until the other machines answer, here and at the exit of Python
            leave = partial(atexit.register, _exit_interrupted)
        raise
    finally:
        leave()


def _exit_interrupted() -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(130)


def _join(group: TrainingGroup, file: str | None) -> None:
    """Connect to the other processes in a thread, so that signals are handled meanwhile.

    Processes of one machine are watched, so that they may take long to begin. Others have a minute.
    """
    limit = _CONNECTION if file is None else _ANSWER
    names = [f"splatbot/{rank}" for rank in range(group.size)]
    failed: list[Exception] = []

    def join() -> None:
        try:
            if file is None:
                store, _, _ = next(dist.rendezvous("env://", group.rank, group.size, timeout=limit))
            else:
                store = dist.FileStore(file, group.size)
            store.set(names[group.rank], "")
            store.wait(names, limit)
            dist.init_process_group("gloo", store=store, rank=group.rank, world_size=group.size, timeout=_ANSWER)
        except Exception as error:
            failed.append(error)

    thread, began = Thread(target=join, daemon=True), time.monotonic()
    thread.start()
    while thread.is_alive():
        thread.join(_POLL_S)
        waited_s = time.monotonic() - began
        group.watch(waited_s)
        if waited_s > limit.total_seconds():
            raise RuntimeError(f"no connection within {limit.total_seconds():g} s")
    if failed:
        raise failed[0]


@contextmanager
def _answering() -> Iterator[None]:
    """Turn an error of the connection in the block into a LostProcessError."""
    try:
        yield
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0].rstrip(".")
        raise LostProcessError(f"another process does not answer ({reason}).", field="processes") from error


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
