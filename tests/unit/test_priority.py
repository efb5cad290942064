"""Priorities of threads."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable

import pytest

from splatbot.priority import lower_priority, switch_quickly

linux = pytest.mark.skipif(sys.platform != "linux", reason="a priority is a thread's own on Linux alone")


def _in_thread(work: Callable[[], object]) -> None:
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()


@linux
def test_a_thread_that_stands_back_and_those_it_starts_have_a_lower_priority_and_no_other() -> None:
    before, seen = os.getpriority(os.PRIO_PROCESS, 0), []

    def look() -> None:
        seen.append(os.getpriority(os.PRIO_PROCESS, 0))

    def work() -> None:
        lower_priority(19)
        look()
        _in_thread(look)

    _in_thread(work)
    assert seen == [19, 19]
    assert os.getpriority(os.PRIO_PROCESS, 0) == before


def test_the_interpreter_is_handed_over_within_half_a_millisecond() -> None:
    before = sys.getswitchinterval()
    try:
        switch_quickly()
        assert sys.getswitchinterval() <= 5e-4
    finally:
        sys.setswitchinterval(before)
