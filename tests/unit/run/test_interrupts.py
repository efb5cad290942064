"""Interrupts: a request everywhere, an exception only where work may be cut short."""

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


def test_no_signal_raises_where_nothing_may_be_cut_short() -> None:
    with Interrupts() as interrupts:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
            send(number)
        assert interrupts.requested == signal.SIGINT


def test_a_signal_before_and_after_its_callback_is_set_calls_it() -> None:
    calls: list[str] = []
    with Interrupts() as interrupts:
        send()
        interrupts.when_requested = lambda: calls.append("called")
        assert calls == ["called"]
        send()
        assert calls == ["called"] * 2
    with Interrupts() as interrupts:
        interrupts.when_requested = lambda: calls.append("called")
    assert calls == ["called"] * 2


@pytest.mark.parametrize("before", [0, 1])
def test_an_interruptible_block_ends_at_the_first_signal_beyond_those_allowed(before: int) -> None:
    reached = []

    def work(interrupts: Interrupts) -> None:
        with interrupts.interruptible(after=before):
            reached.append("begun")
            send()
            reached.append("not cut")

    with Interrupts() as interrupts:
        for _ in range(before):
            send()
        with pytest.raises(KeyboardInterrupt):
            work(interrupts)
        assert interrupts.requested == signal.SIGINT
    assert reached == ["begun"]


@pytest.mark.parametrize("after", [0, 1])
def test_an_interruptible_block_is_not_begun_after_too_many_signals(after: int) -> None:
    reached = []
    with Interrupts() as interrupts:
        for _ in range(after + 1):
            send()
        with pytest.raises(KeyboardInterrupt), interrupts.interruptible(after=after):
            reached.append("begun")
    assert not reached


def test_after_the_block_and_while_it_is_left_a_signal_is_a_request_again() -> None:
    reached = []

    def work(interrupts: Interrupts) -> None:
        with interrupts.interruptible():
            try:
                send()
            finally:
                send()  # while the first is being answered
                reached.append("cleaned up")

    with Interrupts() as interrupts:
        with pytest.raises(KeyboardInterrupt):
            work(interrupts)
        send()
    assert reached == ["cleaned up"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("late", [False, True])
def test_a_signal_in_the_moment_in_which_ctrl_c_ends_a_camera_is_not_lost(number: int, late: bool) -> None:
    class Signalled(Interrupts):
        """A second signal arrives just before or after the first one counts no longer."""

        def __setattr__(self, name: str, value: object) -> None:
            settled = name == "requested" and value is None and vars(self).get(name) is not None
            if settled and not late:
                send(number)
            super().__setattr__(name, value)
            if settled and late:
                send(number)

    with Signalled() as interrupts:
        send()
        assert not interrupts.end_of_camera()
        assert interrupts.requested == number
        with pytest.raises(KeyboardInterrupt), interrupts.interruptible():
            pass


def test_ctrl_c_that_ended_a_camera_cuts_nothing_that_follows_and_the_next_one_does() -> None:
    with Interrupts() as interrupts:
        send()
        assert interrupts.end_of_camera()
        assert interrupts.requested is None
        reached = []
        with interrupts.interruptible():
            reached.append("scored")
        with pytest.raises(KeyboardInterrupt), interrupts.interruptible():
            send()
        assert reached == ["scored"]
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
