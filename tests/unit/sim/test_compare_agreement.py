"""Statistics over policies against scipy, and against cases computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from splatbot.errors import InputError
from splatbot.sim.compare.agreement import (
    agreement,
    mean_maximum_rank_violation,
    pearson,
    reliability,
    wilson,
)


def test_the_correlation_is_scipys(rng: np.random.Generator) -> None:
    for count in (2, 5, 40):
        a, b = rng.uniform(size=(2, count))
        assert pearson(a, b) == pytest.approx(float(stats.pearsonr(a, b).statistic), abs=1e-12)


@pytest.mark.parametrize("row", [[0.1] * 7, [1.0] * 5, [0.3]])
def test_a_correlation_with_what_does_not_vary_is_not_defined(row: list[float]) -> None:
    other = np.linspace(0.0, 1.0, len(row))
    assert pearson(row, other) is None
    assert pearson(other, row) is None


def test_equal_ranks_violate_nothing_however_far_the_figures_are_apart() -> None:
    assert mean_maximum_rank_violation([0.1, 0.2, 0.3], [0.0, 0.5, 1.0]) == 0.0
    assert mean_maximum_rank_violation([0.5], [0.9]) == 0.0
    assert mean_maximum_rank_violation([], []) is None


def test_a_swapped_pair_counts_by_how_much_it_differs_in_truth() -> None:
    # The simulation swaps the first two, whose truth differs by 0.1; the third is right with both: (0.1 + 0.1 + 0) / 3.
    assert mean_maximum_rank_violation([0.5, 0.4, 0.9], [0.4, 0.5, 0.9]) == pytest.approx(0.2 / 3)


def test_reversed_ranks_are_the_worst() -> None:
    # Each policy's worst opponent is the farthest: 1, max(0.5, 0.5), 1.
    assert mean_maximum_rank_violation([1.0, 0.5, 0.0], [0.0, 0.5, 1.0]) == pytest.approx((1 + 0.5 + 1) / 3)


def test_a_tie_in_the_simulation_violates_what_truth_tells_apart() -> None:
    # Truth says i < j, the simulation does not; the other way round, "less" holds in neither: one violation.
    assert mean_maximum_rank_violation([0.5, 0.5], [0.2, 0.6]) == pytest.approx(0.4 / 2)


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (10, 10), (3, 7), (81, 263)])
def test_shares_have_wilsons_interval(successes: int, trials: int) -> None:
    theirs = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    ours = wilson(successes, trials)
    assert ours.value == successes / trials
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_intervals_of_a_drop_cover_it_about_as_often_as_they_say(rng: np.random.Generator) -> None:
    held = 0
    for _ in range(200):
        a, b = rng.uniform(size=(1, 60)) < 0.8, rng.uniform(size=(1, 60)) < 0.5
        found = agreement(["p"], a, b, resamples=300, seed=int(rng.integers(1 << 30))).drop
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 0.3 <= found.high
    assert 0.88 <= held / 200 <= 0.99


def test_the_same_seed_gives_the_same_intervals_and_paired_trials_stay_paired(rng: np.random.Generator) -> None:
    a = rng.uniform(size=(6, 30)) < np.linspace(0.1, 0.9, 6)[:, None]
    b = a & (rng.uniform(size=a.shape) < 0.8)
    names = [f"policy {i}" for i in range(6)]
    first, again, other = (agreement(names, a, b, seed=seed) for seed in (3, 3, 4))
    assert first == again
    assert first.pearson != other.pearson
    # Equal results in every trial: no resample may separate the twins, as independent resampling of each would.
    same = agreement(names, a, a)
    assert (same.drop.value, same.drop.low, same.drop.high) == (0.0, 0.0, 0.0)
    assert (same.mmrv.low, same.mmrv.high) == (0.0, 0.0)
    assert same.pearson.low == pytest.approx(1.0)


def test_policies_that_all_succeed_have_no_correlation_and_say_why() -> None:
    found = agreement(["a", "b"], np.ones((2, 9)), [[1] * 9, [0] * 9])
    assert found.pearson.value is None
    assert "does not vary" in found.pearson.note
    assert found.drop.value == 0.5
    assert found.mmrv.value == pytest.approx(0.5)


def test_resamples_without_a_correlation_are_counted() -> None:
    found = agreement(["a", "b"], [[1, 0, 0, 0], [0, 0, 0, 0]], [[1, 0, 0, 0], [0, 0, 0, 0]])
    assert found.pearson.value == pytest.approx(1.0)
    assert "resamples left out" in found.pearson.note


def test_promises_are_compared_bin_by_bin() -> None:
    promised = [0.001, 0.004, 0.012, 0.015, 0.2]
    measured = [0.002, -0.003, 0.012, 0.014, 0.3]
    rows = reliability(promised, measured, [False, True, False, False, False])
    assert [(row.low, row.count, row.in_contact) for row in rows] == [(0.0, 2, 1), (0.01, 2, 0), (0.05, 1, 0)]
    assert [row.kept.value for row in rows] == [0.5, 0.5, 1.0]
    assert rows[0].worst == pytest.approx(0.007)
    assert rows[2].worst == pytest.approx(-0.1)


def test_rows_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="P, T"):
        agreement(["a"], np.ones((2, 3)), np.ones((2, 3)))
    with pytest.raises(InputError, match="finite"):
        pearson([0.1, np.nan], [0.1, 0.2])


def test_the_interval_holds_its_rate_at_0_and_1_for_every_number_of_trials() -> None:
    for trials in range(1, 201):
        for rate, found in ((0.0, wilson(0, trials)), (1.0, wilson(trials, trials))):
            assert found.low is not None
            assert found.high is not None
            assert found.low <= rate <= found.high
