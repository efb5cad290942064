"""Whether one simulation ranks policies as another does: Pearson's r and SIMPLER's MMRV, with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.protocols import Array

LEVEL = 0.95  # of all intervals
_Z = 1.959963984540054  # of the normal distribution at that level


@dataclass(frozen=True)
class Interval:
    """A figure with the interval that holds it in 95 of 100 repetitions; None where it is not defined.

    Args:
        value: the figure.
        low, high: ends of the interval.
        note: why a figure, or some of the resamples that the interval comes from, is not defined; empty if all are.
    """

    value: float | None
    low: float | None
    high: float | None
    note: str = ""


@dataclass(frozen=True)
class PolicyScore:
    """One policy in both twins.

    Args:
        name: the policy's.
        trials: how many.
        in_map, in_held_out: share of the trials with success in the twin of the map, and in the held-out one.
        drop: the first less the second.
        refused: trials in which the policy gave no motion; a failure in both.
    """

    name: str
    trials: int
    in_map: Interval
    in_held_out: Interval
    drop: Interval
    refused: int


@dataclass(frozen=True)
class Agreement:
    """Success of several policies in the twin of the map against that in the held-out twin.

    Args:
        policies: one by one.
        drop: mean over them.
        pearson: correlation of the success shares over the policies.
        mmrv: mean maximum rank violation, 0 for equal ranks.
    """

    policies: tuple[PolicyScore, ...]
    drop: Interval
    pearson: Interval
    mmrv: Interval


@dataclass(frozen=True)
class ReliabilityRow:
    """Motions whose promised clearance is in one bin, against what was measured.

    Args:
        low, high: the bin [m]; ``high`` may be infinity.
        count: of motions.
        kept: share of them with at least the clearance that was promised.
        touched: of them, how many touched.
        promised, measured: medians [m].
        worst: largest shortfall of measured against promised [m]; negative where all had more.
    """

    low: float
    high: float
    count: int
    kept: Interval
    touched: int
    promised: float
    measured: float
    worst: float


def pearson(a: ArrayLike, b: ArrayLike) -> float | None:
    """Correlation of two rows (P,) of numbers; None for fewer than two of them, or where one does not vary."""
    x, y = _pair(a, b)
    if len(x) < 2:
        return None
    x, y = x - x.mean(), y - y.mean()
    length = float(np.linalg.norm(x) * np.linalg.norm(y))
    # The mean of equal numbers may differ from them in the last bit.
    if length <= 1e-12:
        return None
    return float(np.clip(x @ y / length, -1.0, 1.0))


def mean_maximum_rank_violation(simulated: ArrayLike, real: ArrayLike) -> float | None:
    """MMRV of SIMPLER (Li et al. 2024, eq. 1): for each policy, the worst ``|real_i - real_j|`` over those that the
    simulation ranks otherwise; the mean over policies. 0 is best, 1 worst; None without policies.

    Args:
        simulated: (P,) success in the simulation that is judged.
        real: (P,) success in what it stands for.
    """
    sim, truth = _pair(simulated, real)
    if not len(sim):
        return None
    violated = (sim[:, None] < sim[None]) != (truth[:, None] < truth[None])
    return float((np.abs(truth[:, None] - truth[None]) * violated).max(axis=1).mean())


def wilson(successes: int, trials: int) -> Interval:
    """A share with Wilson's score interval (Wilson 1927): of use for 0 and for all successes too."""
    if trials < 1:
        return Interval(None, None, None, "no trials")
    p, z2 = successes / trials, _Z**2
    middle = (p + z2 / (2 * trials)) / (1 + z2 / trials)
    half = _Z * float(np.sqrt(p * (1 - p) / trials + z2 / (4 * trials**2))) / (1 + z2 / trials)
    return Interval(p, max(0.0, middle - half), min(1.0, middle + half))


def agreement(
    names: Sequence[str],
    in_map: ArrayLike,
    in_held_out: ArrayLike,
    refused: ArrayLike | None = None,
    *,
    resamples: int = 2000,
    seed: int = 0,
) -> Agreement:
    """Scores of P policies over T trials, the same ones for all policies and both twins.

    Intervals are percentiles over resampled trials (Efron and Tibshirani 1993, ch. 13): what belongs to one trial is
    drawn together. The same seed gives the same intervals.

    Args:
        names: of the policies.
        in_map, in_held_out: (P, T) bool, success.
        refused: (P, T) bool, whether there was no motion at all.
        resamples: how many.
        seed: of the resampling.

    Raises:
        InputError: shapes do not fit, or there is no policy or no trial.
    """
    a, b = (np.asarray(x, dtype=np.bool_) for x in (in_map, in_held_out))
    none = np.zeros_like(a) if refused is None else np.asarray(refused, dtype=np.bool_)
    if a.ndim != 2 or a.shape != b.shape or a.shape != none.shape or len(names) != len(a) or not a.size:
        raise InputError(f"are {a.shape} and {b.shape}.", field="trials", hint="give (P, T) of each, P and T above 0")
    picks = np.random.default_rng(seed).integers(0, a.shape[1], (resamples, a.shape[1]))
    shares_a, shares_b = a.mean(axis=1), b.mean(axis=1)
    drawn_a, drawn_b = a[:, picks].mean(axis=2), b[:, picks].mean(axis=2)  # (P, R)
    drops = drawn_a - drawn_b
    rows = tuple(
        PolicyScore(
            name,
            a.shape[1],
            wilson(int(a[i].sum()), a.shape[1]),
            wilson(int(b[i].sum()), a.shape[1]),
            _interval(float(shares_a[i] - shares_b[i]), list(drops[i])),
            int(none[i].sum()),
        )
        for i, name in enumerate(names)
    )
    return Agreement(
        rows,
        _interval(float((shares_a - shares_b).mean()), list(drops.mean(axis=0))),
        _measured(pearson, shares_a, shares_b, drawn_a, drawn_b, "success does not vary over the policies"),
        _measured(mean_maximum_rank_violation, shares_a, shares_b, drawn_a, drawn_b, "no policies"),
    )


def reliability(
    promised: ArrayLike,
    measured: ArrayLike,
    touched: ArrayLike,
    edges: Sequence[float] = (0.0, 0.005, 0.01, 0.02, 0.05, np.inf),
) -> tuple[ReliabilityRow, ...]:
    """Bins of promised clearance against what was measured; empty bins are left out.

    Args:
        promised, measured: (M,) [m] of each motion.
        touched: (M,) bool.
        edges: of the bins [m], ascending.
    """
    p, m = _pair(promised, measured)
    hit = np.asarray(touched, dtype=np.bool_)
    rows = []
    for low, high in pairwise(edges):
        here = (p >= low) & (p < high)
        if here.any():
            kept = wilson(int((m[here] >= p[here]).sum()), int(here.sum()))
            medians = float(np.median(p[here])), float(np.median(m[here]))
            worst = float((p[here] - m[here]).max())
            rows.append(ReliabilityRow(low, high, int(here.sum()), kept, int(hit[here].sum()), *medians, worst))
    return tuple(rows)


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[Array, Array]:
    x, y = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(f"are {x.shape} and {y.shape}.", field="scores", hint="give two rows of finite numbers")
    return x, y


def _measured(
    figure: Callable[[Array, Array], float | None],
    a: Array,
    b: Array,
    drawn_a: NDArray[np.float64],
    drawn_b: NDArray[np.float64],
    why: str,
) -> Interval:
    value = figure(a, b)
    if value is None:
        return Interval(None, None, None, f"not defined: {why}")
    return _interval(value, [figure(x, y) for x, y in zip(drawn_a.T, drawn_b.T, strict=True)])


def _interval(value: float, drawn: Sequence[float | None]) -> Interval:
    known = [x for x in drawn if x is not None]
    if not known:
        return Interval(value, None, None, "no resample defines it")
    low, high = np.percentile(known, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    lost = len(drawn) - len(known)
    return Interval(value, float(low), float(high), f"{lost} of {len(drawn)} resamples left out" if lost else "")
