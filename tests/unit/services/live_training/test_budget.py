"""The account of the viewer's time, with a clock that the tests set."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatbot.services.live_training.budget import CONSTANTS, ImageCosts, ViewerBudget


class SetClock:
    """A clock that only moves when a test moves it."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_work_begins_once_a_twentieth_of_the_elapsed_time_covers_it_twice() -> None:
    clock = SetClock()
    budget = ViewerBudget(clock)
    assert not budget.covers(0.01)
    clock.now += CONSTANTS.margin * 0.2 - 0.001
    assert not budget.covers(0.01)
    clock.now += 0.002
    assert budget.covers(0.01)
    budget.spend(0.01)
    assert not budget.covers(0.01)
    assert budget.used == pytest.approx(0.01 / (CONSTANTS.margin * 0.2 + 0.001))


def test_an_idle_hour_saves_up_no_more_than_a_burst() -> None:
    clock = SetClock()
    budget = ViewerBudget(clock)
    clock.now += 3600
    done = 0
    while budget.covers(0.1):
        budget.spend(0.1)
        done += 1
    assert done == 4  # 0.5, 0.4, 0.3 and 0.2 s are saved up


def test_dear_work_is_saved_up_for_while_cheap_work_goes_on() -> None:
    clock, begun = SetClock(), 0
    budget = ViewerBudget(clock)
    for _ in range(2000):
        clock.now += 0.1
        if budget.covers(1e-3):
            budget.spend(1e-3)
        if budget.covers(1.0):
            budget.spend(1.0)
            begun += 1
        assert budget.used <= CONSTANTS.share
    assert begun == 7  # 10 s of credit, less 2 s for 2,000 times 1 ms, and one margin that is kept


def test_work_that_took_longer_than_predicted_is_repaid_before_the_next() -> None:
    clock = SetClock()
    budget = ViewerBudget(clock)
    clock.now += 10
    assert budget.covers(0.25)
    budget.spend(2.0)  # a debt of 1.5 s
    clock.now += 1.5 / CONSTANTS.share - 0.1
    assert not budget.covers(0.0)
    clock.now += 0.2
    assert budget.covers(0.0)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(st.floats(0, 5), st.floats(0, 2)), max_size=200))
def test_with_true_predictions_the_share_is_never_above_a_twentieth(steps: list[tuple[float, float]]) -> None:
    clock = SetClock()
    budget = ViewerBudget(clock)
    for elapsed, cost in steps:
        clock.now += elapsed
        if budget.covers(cost):
            clock.now += cost
            budget.spend(cost)
        assert budget.used <= CONSTANTS.share + 1e-9


def test_costs_are_bounded_by_the_pixels_and_a_later_image_may_be_cheaper() -> None:
    costs = ImageCosts()
    assert costs.predict(400, 7.0) == 7.0
    costs.note(200, 0.01)
    assert costs.predict(100, 7.0) == 0.01
    assert costs.predict(400, 7.0) == pytest.approx(0.04)
    costs.note(400, 0.02)
    assert costs.predict(300, 7.0) == 0.02
    costs.note(400, 0.001)
    assert costs.predict(400, 7.0) == pytest.approx(0.016)
    assert costs.largest([100, 200, 400], 0.012, 7.0) == 200
    assert costs.largest([100, 200, 400], 0.001, 7.0) == 100
