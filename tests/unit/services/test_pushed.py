"""Frames that clients push: answered each, bounded, in order, and never left waiting."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.services.problems import BusyError
from splatbot.services.pushed import PushedFrames, StreamEndedError
from splatbot.slam import FrameResult


def _frame(stamp: float, width: int = 4) -> Frame:
    camera = Camera(10, 10, 1.5, 1.5, width, 4)
    return Frame(stamp, np.zeros((4, width, 3), np.uint8), np.ones((4, width), np.float32), camera)


def test_each_frame_is_answered_by_what_became_of_it() -> None:
    frames = PushedFrames(capacity=10)
    answers = [frames.push(_frame(t)) for t in (1.0, 2.0, 3.0)]
    frames.end()

    def read() -> None:
        for frame in frames:
            frames.answer(FrameResult(frame.index, frame.stamp, np.eye(4), "ok"))

    reader = threading.Thread(target=read)
    reader.start()
    assert [a.result(5).stamp for a in answers] == [1.0, 2.0, 3.0]
    reader.join(5)
    assert not reader.is_alive()


def test_more_frames_than_may_wait_are_refused_and_not_mapped() -> None:
    frames = PushedFrames(capacity=2)
    frames.push(_frame(1.0))
    frames.push(_frame(2.0))
    with pytest.raises(BusyError, match="2 frames wait"):
        frames.push(_frame(3.0))
    frames.answer(FrameResult(0, 1.0, None, "lost"))
    frames.push(_frame(3.0))
    frames.end()
    assert [f.stamp for f in frames] == [1.0, 2.0, 3.0]


def test_a_frame_of_another_size_or_out_of_order_is_refused_alone() -> None:
    frames = PushedFrames()
    frames.push(_frame(1.0))
    with pytest.raises(InputError, match="8 x 4"):
        frames.push(_frame(2.0, width=8))
    with pytest.raises(InputError, match="not after"):
        frames.push(_frame(1.0))
    frames.push(_frame(2.0))


def test_after_the_end_nothing_is_taken_and_nobody_waits_for_ever() -> None:
    frames = PushedFrames()
    answer = frames.push(_frame(1.0))
    frames.abandon("the service stops")
    with pytest.raises(StreamEndedError, match="the service stops"):
        answer.result(5)
    with pytest.raises(StreamEndedError, match="no more frames"):
        frames.push(_frame(2.0))
