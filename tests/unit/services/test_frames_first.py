"""Queries wait for frames, for a bounded time."""

from __future__ import annotations

import threading

import pytest

from splatbot.services.frames_first import FramesFirst


def test_nobody_waits_while_nothing_is_mapped() -> None:
    assert FramesFirst(patience_s=60.0).wait()


def test_an_answer_comes_after_the_frame_also_after_one_that_failed() -> None:
    first, told = FramesFirst(patience_s=60.0), threading.Event()

    def answer() -> None:
        if first.wait():
            told.set()

    asked = threading.Thread(target=answer)

    def fails() -> None:
        with first.mapping():
            asked.start()
            assert not told.wait(0.05)
            raise ValueError("bad frame")

    with pytest.raises(ValueError, match="bad frame"):
        fails()
    assert told.wait(10)
    asked.join(10)


def test_patience_ends() -> None:
    first = FramesFirst(patience_s=0.01)
    with first.mapping():
        assert not first.wait()
    assert first.wait()
