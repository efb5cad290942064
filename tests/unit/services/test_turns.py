"""Turns at a mapper: frames one after the other, and a thread between two of them."""

from __future__ import annotations

import threading

import pytest

from splatbot.services.problems import BusyError
from splatbot.services.turns import Turns
from tests.waiting import until


def test_a_thread_between_frames_comes_before_the_next_frame_of_a_stream_without_pauses() -> None:
    turns, order, stop = Turns(), list[str](), threading.Event()

    def stream() -> None:
        while not stop.is_set():
            with turns.frame():
                order.append("frame")

    mapping = threading.Thread(target=stream)
    mapping.start()
    until(lambda: len(order) > 100)
    for _ in range(20):
        with turns.between_frames(10.0):
            before = len(order)
            order.append("between")
            assert order[before:] == ["between"]
    stop.set()
    mapping.join()
    assert order.count("between") == 20


def test_a_frame_that_takes_too_long_is_not_waited_for_and_the_next_one_is_mapped() -> None:
    turns = Turns()
    with turns.frame(), pytest.raises(BusyError, match="at work"), turns.between_frames(0.01):
        pass
    with turns.frame():
        pass
    with turns.between_frames(1.0):
        pass


def test_threads_between_frames_take_turns() -> None:
    turns, inside, most = Turns(), 0, 0

    def work() -> None:
        nonlocal inside, most
        with turns.between_frames(10.0):
            inside += 1
            most = max(most, inside)
            inside -= 1

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1


def test_an_error_in_a_turn_gives_it_back() -> None:
    turns = Turns()
    with pytest.raises(ZeroDivisionError), turns.between_frames(1.0):
        _ = 1 // 0
    with turns.frame():
        pass


def test_a_frame_is_mapped_between_two_turns_of_threads_that_save_in_a_loop() -> None:
    turns, order, stop = Turns(), list[str](), threading.Event()

    def save() -> None:
        while not stop.is_set():
            with turns.between_frames(10.0):
                order.append("between")

    def one_frame() -> None:
        with turns.frame():
            order.append("frame")

    savers = [threading.Thread(target=save) for _ in range(3)]
    with turns.frame():
        for saver in savers:
            saver.start()
        until(lambda: turns._between == 3)
    for _ in range(20):
        with turns.between_frames(10.0):
            frame = threading.Thread(target=one_frame)
            frame.start()
            until(lambda: turns._frames == 1)
            before = len(order)
        frame.join()
        assert order[before] == "frame"
    stop.set()
    for saver in savers:
        saver.join()
