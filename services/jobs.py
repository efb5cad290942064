"""Work that outlasts a request: queued, run one after the other, watched, cancelled."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal
from uuid import uuid4

from splatbot.errors import InputError, SplatbotError
from splatbot.services.bus import Bus
from splatbot.services.problems import DISK_ERRORS, BusyError, disk_error
from splatbot.services.topics import job_topic

_log = logging.getLogger(__name__)

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
ENDED: frozenset[JobState] = frozenset({"succeeded", "failed", "cancelled"})

_KEPT = 200  # ended jobs that are kept for queries


class JobNotFoundError(InputError):
    """No job of that id, or it ended long ago."""

    http_status = 404


class IdempotencyError(InputError):
    """A key has been used for another request."""

    http_status = 409


class TooManyJobsError(InputError):
    """As many jobs of one client wait or run as may."""

    http_status = 429


class JobCancelled(Exception):  # noqa: N818 (no error: somebody wanted it)
    """Ends the work of a job that is no longer wanted."""


@dataclass(frozen=True)
class Job:
    """One piece of work at one moment.

    Args:
        id: its name in URLs.
        kind: kind of work, e.g. "map".
        state: state; the last three are final.
        progress: 0..1.
        detail: present activity, or the reason of a failure.
        result: result of the job.
        created, started, ended: Unix time [s].
        client: that the job is for; empty if it counts in no quota.
    """

    id: str
    kind: str
    state: JobState = "queued"
    progress: float = 0.0
    detail: str | None = None
    result: dict[str, Any] | None = field(default=None, repr=False)
    created: float = field(default_factory=time.time)
    started: float | None = None
    ended: float | None = None
    client: str = ""


class JobHandle:
    """Interface of a job to the function that does its work."""

    def __init__(self, jobs: Jobs, job_id: str) -> None:
        self._jobs = jobs
        self.id = job_id
        self.cancelled = threading.Event()

    def check(self) -> None:
        """Check that the job is still wanted.

        Raises:
            JobCancelled: it was cancelled.
        """
        if self.cancelled.is_set():
            raise JobCancelled

    def report(self, progress: float, detail: str | None = None) -> None:
        """Report the progress (0..1) and the present activity.

        Raises:
            JobCancelled: the job was cancelled.
        """
        self.check()
        self._jobs._change(self.id, progress=min(max(progress, 0.0), 1.0), detail=detail)


Work = Callable[[JobHandle], dict[str, Any]]


class Jobs:
    """A queue of jobs and the threads that work on it; every change of a job goes to the bus (``jobs/{id}``).

    Args:
        bus: receives each change.
        workers: jobs that run at once.
        capacity: jobs that may wait.
        client_capacity: jobs of one client that may wait or run. If None, any number.
    """

    def __init__(self, bus: Bus, *, workers: int = 1, capacity: int = 16, client_capacity: int | None = None) -> None:
        self._bus = bus
        self._capacity, self._client_capacity = capacity, client_capacity
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._jobs: dict[str, Job] = {}
        self._handles: dict[str, JobHandle] = {}
        self._keys: dict[str, tuple[str, str]] = {}
        self._abandoned: dict[str, Callable[[], None]] = {}
        self._waiting: queue.Queue[tuple[JobHandle, Work] | None] = queue.Queue()
        self._closed = False
        self._threads = [threading.Thread(target=self._run, name=f"job-{i}", daemon=True) for i in range(workers)]
        for thread in self._threads:
            thread.start()

    def submit(
        self,
        kind: str,
        work: Work,
        *,
        key: str | None = None,
        request: str = "",
        abandoned: Callable[[], None] | None = None,
        client: str = "",
    ) -> tuple[Job, bool]:
        """Queue work; the job and whether it is new.

        Args:
            kind: kind of work.
            work: runs in a thread and returns the result; its SplatbotErrors become the job's detail.
            key: of the request (Idempotency-Key): a repeated request with it returns the same job.
            request: content of the request; another request with the same key is refused.
            abandoned: called instead of ``work`` when the job is cancelled before it begins.
            client: that the job is for.

        Raises:
            BusyError: as many jobs wait as may, or the service is about to stop.
            TooManyJobsError: as many jobs of the client wait or run as may.
            IdempotencyError: the key belongs to another request.
        """
        with self._lock:
            known = self._known(key, request)
            if known is not None:
                return known, False
            waiting = sum(job.state == "queued" for job in self._jobs.values())
            if self._closed or waiting >= self._capacity:
                why = "the service is stopping" if self._closed else f"{waiting} jobs wait"
                raise BusyError(f"{why}.", hint="try again later")
            own = self.count(client)
            if client and self._client_capacity is not None and own >= self._client_capacity:
                hint = "wait for one of them, cancel one, or raise SPLATBOT_MAX_CLIENT_JOBS"
                raise TooManyJobsError(f"{own} jobs of this client wait or run.", hint=hint)
            job = Job(uuid4().hex[:16], kind, client=client)
            handle = JobHandle(self, job.id)
            self._jobs[job.id], self._handles[job.id] = job, handle
            if key is not None:
                self._keys[key] = job.id, request
            self._publish(job)
            self._waiting.put((handle, work))
            if abandoned is not None:
                self._abandoned[job.id] = abandoned
            self._forget_old()
        return job, True

    def known(self, key: str | None, request: str) -> Job | None:
        """Return the job that an earlier request with this key created, if any.

        Raises:
            IdempotencyError: the key belongs to another request.
        """
        with self._lock:
            return self._known(key, request)

    def uses(self, key: str) -> bool:
        """Return whether a request with this key created a job."""
        with self._lock:
            return key in self._keys

    def get(self, job_id: str) -> Job:
        """Return the present state of a job.

        Raises:
            JobNotFoundError: the id is unknown.
        """
        with self._lock:
            return self._find(job_id)

    def list(self) -> tuple[Job, ...]:
        """List all jobs, oldest first."""
        with self._lock:
            return tuple(self._jobs.values())

    def count(self, client: str) -> int:
        """Return the number of jobs of a client that wait or run."""
        with self._lock:
            return sum(job.client == client and job.state not in ENDED for job in self._jobs.values())

    def cancel(self, job_id: str) -> Job:
        """Request the end of a job. A waiting job ends now, a running one at its next progress report.

        Raises:
            JobNotFoundError: the id is unknown.
        """
        with self._lock:
            job = self._find(job_id)
            self._handles[job_id].cancelled.set()
            abandoned = None
            if job.state == "queued":
                job = self._put(replace(job, state="cancelled", ended=time.time()))
                abandoned = self._abandoned.pop(job_id, None)
        if abandoned is not None:
            abandoned()
        return job

    def end(self, job_id: str, timeout_s: float) -> bool:
        """Cancel a job and wait for its end up to ``timeout_s`` [s]; return whether it has ended or is unknown."""
        try:
            self.cancel(job_id)
        except JobNotFoundError:
            return True
        with self._changed:
            return self._changed.wait_for(
                lambda: job_id not in self._jobs or self._jobs[job_id].state in ENDED, timeout_s
            )

    def stop(self) -> None:
        """Take no more and cancel all."""
        with self._lock:
            self._closed = True
            running = list(self._jobs.values())
        for job in running:
            if job.state not in ENDED:
                self.cancel(job.id)

    def close(self, timeout_s: float) -> None:
        """Take no more, cancel all, and wait for those that run up to ``timeout_s`` [s]."""
        self.stop()
        for _ in self._threads:
            self._waiting.put(None)
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _run(self) -> None:
        while (item := self._waiting.get()) is not None:
            self._work(*item)

    def _work(self, handle: JobHandle, work: Work) -> None:
        with self._lock:
            job = self._jobs[handle.id]
            if job.state != "queued":
                return
            self._put(replace(job, state="running", started=time.time()))
            self._abandoned.pop(handle.id, None)
        try:
            result = work(handle)
            self._change(handle.id, state="succeeded", progress=1.0, detail=None, result=result, ended=time.time())
        except JobCancelled:
            self._change(handle.id, state="cancelled", ended=time.time())
        except SplatbotError as error:
            detail = f"{error.field}: {error.message}" if error.field else error.message
            self._change(handle.id, state="failed", detail=detail, ended=time.time())
        except Exception as error:
            if isinstance(error, OSError) and error.errno in DISK_ERRORS:
                _log.error("job %s failed: %s", handle.id, error)
                self._change(handle.id, state="failed", detail=disk_error(error).message, ended=time.time())
                return
            _log.exception("job %s failed", handle.id)
            detail = "unexpected error; the service's log says more"
            self._change(handle.id, state="failed", detail=detail, ended=time.time())

    def _change(self, job_id: str, **changes: Any) -> None:
        with self._lock:
            self._put(replace(self._jobs[job_id], **changes))

    def _put(self, job: Job) -> Job:
        self._jobs[job.id] = job
        self._publish(job)
        if job.state in ENDED:
            self._changed.notify_all()
        return job

    def _publish(self, job: Job) -> None:
        self._bus.publish(job_topic(job.id), job)

    def _known(self, key: str | None, request: str) -> Job | None:
        if key is None or key not in self._keys:
            return None
        job_id, before = self._keys[key]
        if before != request:
            hint = "use a new key for a new request"
            raise IdempotencyError("was used for another request.", field="Idempotency-Key", hint=hint)
        return self._jobs[job_id]

    def _find(self, job_id: str) -> Job:
        if job_id not in self._jobs:
            raise JobNotFoundError(f"No job {job_id[:40]!r}.", hint="GET /v1/jobs lists them")
        return self._jobs[job_id]

    def _forget_old(self) -> None:
        ended = [job.id for job in self._jobs.values() if job.state in ENDED]
        for job_id in ended[: max(0, len(ended) - _KEPT)]:
            del self._jobs[job_id], self._handles[job_id]
            self._bus.forget(job_topic(job_id))
            self._keys = {key: value for key, value in self._keys.items() if value[0] != job_id}
