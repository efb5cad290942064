"""Interrupts: a request first, an exception second, and never inside a held block."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from splatbot.run.interrupts import Interrupts


def send(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_is_only_a_request(number: int) -> None:
    with Interrupts() as interrupts:
        send(number)
        assert interrupts.requested == number


def test_the_second_signal_raises() -> None:
    with Interrupts() as interrupts:
        send()
        with pytest.raises(KeyboardInterrupt):
            send()
        assert interrupts.requested == signal.SIGINT


def test_nothing_raises_inside_a_held_block_but_it_does_right_after() -> None:
    reached = False
    with Interrupts() as interrupts, pytest.raises(KeyboardInterrupt), interrupts.held():
        send()
        send()
        send()
        reached = True
    assert reached


def test_a_single_signal_inside_a_held_block_is_a_request() -> None:
    with Interrupts() as interrupts:
        with interrupts.held():
            send()
        assert interrupts.requested == signal.SIGINT


def test_after_release_the_first_signal_raises() -> None:
    with Interrupts() as interrupts:
        interrupts.release()
        with pytest.raises(KeyboardInterrupt):
            send()
        assert interrupts.requested == signal.SIGINT


def test_handlers_are_restored_even_after_an_error() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(ValueError, match="inside"), Interrupts():
        raise ValueError("inside")
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_it_works_in_a_thread_where_signals_cannot_be_caught() -> None:
    seen: list[int | None] = []

    def work() -> None:
        with Interrupts() as interrupts:
            seen.append(interrupts.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [None]
