"""Results that are computed once for a version of a map."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from splatbot.services.derived import Derived


def test_many_who_ask_at_once_get_one_result() -> None:
    derived, made, begin = Derived(), [], threading.Barrier(8)

    def make() -> object:
        made.append(object())
        return made[-1]

    def ask() -> object:
        begin.wait(10)
        return derived.get("a", make)

    with ThreadPoolExecutor(8) as pool:
        found = [future.result(10) for future in [pool.submit(ask) for _ in range(8)]]
    assert len(made) == 1
    assert all(result is made[0] for result in found)


def test_other_results_are_worked_out_meanwhile() -> None:
    derived, held = Derived(), threading.Event()
    with ThreadPoolExecutor(1) as pool:
        slow = pool.submit(derived.get, "slow", lambda: held.wait(10))
        assert derived.get("quick", lambda: 3) == 3
        held.set()
        assert slow.result(10) is True


def test_a_failure_is_told_and_tried_again() -> None:
    derived = Derived()

    def fail() -> int:
        raise ValueError("no")

    for _ in range(2):
        with pytest.raises(ValueError, match="no"):
            derived.get("a", fail)
    assert derived.get("a", lambda: 1) == 1


def test_only_the_latest_results_are_kept() -> None:
    derived, made = Derived(capacity=2), []
    for key in "abacab":
        derived.get(key, lambda key=key: made.append(key))  # type: ignore[misc]
    assert made == ["a", "b", "c", "b"]
