"""Workers that run items: processes of this machine, or those of a Ray cluster."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from splatbot.batch.item import BatchItem, ItemRecord, run_item
from splatbot.errors import InputError

Submit = Callable[[BatchItem], Future[ItemRecord]]
"""Queues an item."""

_RETRIES = 3  # of an item whose Ray worker is lost
_STORE_BYTES = 80 * 2**20  # of Ray's shared memory: items pass files, and 75 MB is its minimum
_CONNECT_S = 5.0


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_workers(workers: int, batch: Path, threads: int) -> Iterator[Submit]:
    """Yield a queue of processes on this machine; those that run when the block ends are ended too.

    Args:
        workers: number of processes at a time.
        batch: folder of the batch.
        threads: number of threads of each.
    """
    leash, hold = os.pipe()
    pool = ThreadPoolExecutor(workers)  # each thread waits for one process
    try:
        yield lambda item: pool.submit(run_item, item, batch, Path.cwd(), threads, leash)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        os.close(hold)
        pool.shutdown()
        os.close(leash)


@contextmanager
def ray_workers(address: str, batch: Path, threads: int) -> Iterator[Submit]:
    """Yield a queue on a Ray cluster; items of lost workers are tried again.

    Args:
        address: HOST:PORT of a cluster, "auto" for that of this machine, or "local" for a new one on this machine.
        batch: folder of the batch, on a file system of all nodes.
        threads: number of threads, and of cores that Ray reserves, of each item.

    Raises:
        InputError: Ray is not installed, no cluster answers, or no node has that number of cores.
    """
    ray = _connected(address)
    try:
        cores = max((node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]), default=0)
        if threads > cores:
            raise InputError(f"is {threads}.", field="--threads", hint=f"no node of {address} has over {cores:g} cores")
        supervise = ray.remote(_supervise).options(num_cpus=threads, max_retries=_RETRIES)
        yield lambda item: supervise.remote(item, batch, Path.cwd(), threads).future()
    finally:
        ray.shutdown()


def _supervise(item: BatchItem, batch: Path, place: Path, threads: int) -> ItemRecord:
    """Run an item whose process ends with this one."""
    leash, hold = os.pipe()
    try:
        return run_item(item, batch, place, threads, leash)
    finally:
        os.close(hold)
        os.close(leash)


def _connected(address: str) -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a new cluster would report to its makers
    try:
        import ray
    except ImportError as error:
        hint = "pip install 'splatbot[cluster]'"
        raise InputError("needs Ray, which is not installed.", field="--ray", hint=hint) from error
    init = partial(ray.init, logging_level=logging.ERROR, log_to_driver=False)
    if address == "local":
        init(num_cpus=usable_cores(), include_dashboard=False, object_store_memory=_STORE_BYTES)
        return ray
    hint = "start one (`ray start --head`), give its HOST:PORT, or --ray local"
    try:
        if address != "auto":
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()  # Ray itself waits for minutes
        init(address=address)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"no cluster answers at {address!r} ({error}).", field="--ray", hint=hint) from error
    return ray
