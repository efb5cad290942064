"""Jobs: one after the other, watched, cancelled, and the same request is one job."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from splatbot.errors import InputError
from splatbot.services.bus import Bus
from splatbot.services.jobs import ENDED, IdempotencyError, Job, JobHandle, JobNotFoundError, Jobs
from splatbot.services.problems import BusyError
from splatbot.services.topics import job_topic


@pytest.fixture
def jobs() -> Iterator[Jobs]:
    it = Jobs(Bus(), capacity=3)
    yield it
    it.close(5)


def _ended(jobs: Jobs, job: Job) -> Job:
    deadline = time.monotonic() + 10
    while jobs.get(job.id).state not in ENDED:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return jobs.get(job.id)


def _until_cancelled(handle: JobHandle) -> dict[str, Any]:
    while True:
        handle.report(0.5)
        time.sleep(0.005)


def test_work_is_done_and_its_result_kept(jobs: Jobs) -> None:
    job, new = jobs.submit("add", lambda handle: {"sum": 3})
    done = _ended(jobs, job)
    assert new
    assert (done.state, done.progress, done.result) == ("succeeded", 1.0, {"sum": 3})
    assert done.started is not None
    assert done.ended is not None
    assert done.created <= done.started <= done.ended


def test_every_change_goes_to_the_bus_in_order() -> None:
    bus = Bus()
    jobs = Jobs(bus)
    gate = threading.Event()

    def work(handle: JobHandle) -> dict[str, Any]:
        gate.wait(5)
        handle.report(0.5, "half")
        return {}

    job, _ = jobs.submit("halves", work)
    with bus.subscribe(job_topic(job.id)) as reader:
        gate.set()
        seen: list[Job] = []
        while not seen or seen[-1].state not in ENDED:
            message = reader.get(5)
            assert message is not None
            seen.append(message.value)
    assert [(j.state, j.progress) for j in seen][-2:] == [("running", 0.5), ("succeeded", 1.0)]
    jobs.close(5)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (InputError("is cut off.", file="/srv/x", field="rgb"), "rgb: is cut off."),
        (RuntimeError("password"), "unexpected error; the service's log says more"),
    ],
)
def test_work_that_fails_says_why_and_nothing_of_the_machine(jobs: Jobs, error: Exception, told: str) -> None:
    def work(handle: JobHandle) -> dict[str, Any]:
        raise error

    done = _ended(jobs, jobs.submit("fails", work)[0])
    assert (done.state, done.detail) == ("failed", told)
    assert _ended(jobs, jobs.submit("next", lambda handle: {})[0]).state == "succeeded"


def test_a_running_job_ends_when_cancelled_and_a_waiting_one_never_begins(jobs: Jobs) -> None:
    begun = threading.Event()

    def begin(handle: JobHandle) -> dict[str, Any]:
        begun.set()
        return {}

    running, _ = jobs.submit("first", _until_cancelled)
    abandoned: list[str] = []
    waiting, _ = jobs.submit("second", begin, abandoned=lambda: abandoned.append("second"))
    assert jobs.cancel(waiting.id).state == "cancelled"
    assert abandoned == ["second"], "what was made for it can be undone"
    jobs.cancel(running.id)
    assert _ended(jobs, running).state == "cancelled"
    assert _ended(jobs, jobs.submit("third", lambda handle: {})[0]).state == "succeeded"
    assert not begun.is_set()
    assert jobs.cancel(running.id).state == "cancelled"


def test_more_jobs_than_may_wait_are_refused(jobs: Jobs) -> None:
    first, _ = jobs.submit("first", _until_cancelled)
    while jobs.get(first.id).state == "queued":
        time.sleep(0.005)
    for _ in range(3):
        jobs.submit("waits", lambda handle: {})
    with pytest.raises(BusyError, match="3 jobs wait"):
        jobs.submit("too many", lambda handle: {})


def test_the_same_key_is_the_same_job_and_another_request_under_it_is_refused(jobs: Jobs) -> None:
    first, new = jobs.submit("map", lambda handle: {}, key="k", request="a")
    again, also_new = jobs.submit("map", lambda handle: {}, key="k", request="a")
    assert (first.id, new, also_new) == (again.id, True, False)
    with pytest.raises(IdempotencyError, match="another request"):
        jobs.submit("map", lambda handle: {}, key="k", request="b")


def test_closing_cancels_what_runs_and_takes_no_more() -> None:
    jobs = Jobs(Bus())
    job, _ = jobs.submit("first", _until_cancelled)
    jobs.close(5)
    assert jobs.get(job.id).state == "cancelled"
    with pytest.raises(BusyError, match="stopping"):
        jobs.submit("late", lambda handle: {})


def test_an_unknown_job_is_named(jobs: Jobs) -> None:
    with pytest.raises(JobNotFoundError, match="nope"):
        jobs.get("nope")


def test_old_jobs_are_forgotten_with_their_keys_and_topics(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatbot.services.jobs._KEPT", 2)
    bus = Bus()
    jobs = Jobs(bus)
    for i in range(5):
        last = _ended(jobs, jobs.submit("x", lambda handle: {}, key=str(i))[0])
    assert len(jobs.list()) == 3
    assert bus.topics()[-1] == job_topic(last.id)
    assert len(bus.topics()) == 3
    assert jobs.submit("x", lambda handle: {}, key="0")[1], "the key of a forgotten job is free"
    jobs.close(5)
