"""Paced frames: each at its time, the newest only, and a slow log is not the tracker's fault."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.logs.base import LogBase
from splatbot.run.pacing import LogFrames, PacedSource, _FrameReader
from tests.rgbd import CAMERA
from tests.waiting import until

PERIOD = 0.05


class SetClock:
    """The clock of paced frames, which only sleeping advances: a busy machine is not late on it."""

    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SetClock:
    found = SetClock()
    monkeypatch.setattr("splatbot.run.pacing.time", found)
    return found


class Stream(LogBase):
    """Frames every 50 ms; some cannot be read, and decoding may take its time.

    Attributes:
        asked: frames that may be decoded; None for all of them at once.
    """

    def __init__(self, n: int, *, bad: tuple[int, ...] = (), decode_s: float = 0.0, crash: bool = False) -> None:
        self.n, self.bad, self.decode_s, self.crash = n, bad, decode_s, crash
        self.read_by: set[str] = set()
        self.asked: threading.Semaphore | None = None

    def __len__(self) -> int:
        return self.n

    def _decode(self, index: int) -> Frame:
        self.read_by.add(threading.current_thread().name)
        if self.asked is not None:
            assert self.asked.acquire(timeout=60.0)
        time.sleep(self.decode_s)
        if index in self.bad:
            raise LogError("is damaged.", file=f"{index}.png")
        if self.crash:
            raise RuntimeError("crashed on purpose")
        rgb, depth = np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32)
        return Frame(100.0 + PERIOD * index, rgb, depth, CAMERA, index)


def source(log: Any, *, paced: bool = True, rate: float | None = None) -> LogFrames:
    return PacedSource(log, len(log), rate) if paced else LogFrames(log, len(log))


def test_without_pacing_every_frame_is_delivered_on_demand_and_errors_in_their_place() -> None:
    arrivals = list(source(Stream(4, bad=(2,)), paced=False))
    assert [a.index for a in arrivals] == [0, 1, 2, 3]
    assert [isinstance(a.frame, InputError) for a in arrivals] == [False, False, True, False]


def reading() -> bool:
    """Return whether a thread decodes frames in advance."""
    return any(thread.name == "reading" for thread in threading.enumerate())


@pytest.mark.parametrize("rate", [None, 1 / PERIOD])
def test_frames_come_at_their_times_and_none_is_dropped_or_late_where_there_is_time(
    rate: float | None, clock: SetClock
) -> None:
    frames, begin = source(Stream(5), rate=rate), clock.now
    arrived = [(a.index, clock.now - begin) for a in frames]
    assert [index for index, _ in arrived] == [0, 1, 2, 3, 4]
    assert [at for _, at in arrived] == pytest.approx([PERIOD * index for index in range(5)], abs=1e-9)
    assert frames.dropped == []
    assert frames.late == set()


def test_paced_frames_take_their_time_on_the_clock_of_the_machine() -> None:
    start = time.perf_counter()
    assert list(source(Stream(3)))
    assert time.perf_counter() - start > 2 * PERIOD - 0.01


def test_while_one_frame_is_worked_on_the_next_ones_pass_and_are_counted(clock: SetClock) -> None:
    log = Stream(8)
    frames = source(log)
    taken = []
    for arrival in frames:
        taken.append(arrival.index)
        if arrival.index == 1:
            until(lambda: not reading())  # all frames are decoded
            clock.sleep(3.5 * PERIOD)  # frames 2, 3 and 4 arrive meanwhile
    assert taken == [0, 1, 4, 5, 6, 7]
    assert frames.dropped == [2, 3]
    assert frames.late == {1}
    assert log.read_by == {"reading"}


def test_a_log_slower_than_its_own_pace_costs_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    log, asked, take = Stream(4, decode_s=2 * PERIOD), threading.Semaphore(0), _FrameReader.take
    log.asked = asked

    def ask(reader: _FrameReader, clock: Any) -> Any:
        asked.release()  # none is decoded before, however busy the machine is
        return take(reader, clock)

    monkeypatch.setattr(_FrameReader, "take", ask)
    frames = source(log)
    assert [a.index for a in frames] == [0, 1, 2, 3]
    assert frames.dropped == []
    assert frames.late == set()


def test_a_frame_that_cannot_be_read_has_its_place_also_when_it_is_the_first() -> None:
    arrivals = list(source(Stream(4, bad=(0, 2))))
    assert [(a.index, isinstance(a.frame, InputError)) for a in arrivals][:2] == [(0, True), (1, False)]


def test_a_bug_of_a_reader_is_raised_where_the_frames_are_taken() -> None:
    with pytest.raises(RuntimeError, match="crashed on purpose"):
        list(source(Stream(3, crash=True)))


def test_a_source_that_is_left_early_ends_its_thread() -> None:
    arrivals = iter(source(Stream(100)))
    next(arrivals)
    arrivals.close()
    until(lambda: not reading())
