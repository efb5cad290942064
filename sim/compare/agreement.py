"""Agreement of two simulations on the ranking of policies: Pearson's r and SIMPLER's MMRV, with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.protocols import Array

LEVEL = 0.95  # confidence level of all intervals
_Z = 1.959963984540054  # quantile of the normal distribution at that level


@dataclass(frozen=True)
class Interval:
    """A statistic with its 95 % confidence interval; undefined values (None) have a note.

    Args:
        value: the statistic.
        low, high: ends of the interval.
        note: reason why the statistic or some of the resamples are undefined; empty if all are defined.
    """

    value: float | None
    low: float | None
    high: float | None
    note: str = ""


@dataclass(frozen=True)
class PolicyScore:
    """One policy in both twins.

    Args:
        name: of the policy.
        trials: number of trials.
        in_map, in_held_out: success rate in the twin of the map, and in the held-out one.
        drop: ``in_map`` minus ``in_held_out``.
        refused: trials in which the policy returned no motion; each is a failure in both twins.
    """

    name: str
    trials: int
    in_map: Interval
    in_held_out: Interval
    drop: Interval
    refused: int


@dataclass(frozen=True)
class Agreement:
    """Success rates of several policies in the twin of the map and in the held-out twin.

    Args:
        policies: scores of each policy.
        drop: mean over the policies.
        pearson: correlation of the success rates over the policies.
        mmrv: mean maximum rank violation; 0 for equal ranks.
    """

    policies: tuple[PolicyScore, ...]
    drop: Interval
    pearson: Interval
    mmrv: Interval


@dataclass(frozen=True)
class ReliabilityRow:
    """Simulated clearance of motions whose certified clearance is in one bin.

    Args:
        low, high: the bin [m]; ``high`` may be infinity.
        count: number of motions.
        kept: fraction of motions with at least the certified clearance.
        in_contact: number of motions with a contact.
        promised, measured: median certified and simulated clearance [m].
        worst: largest shortfall of the simulated clearance [m]; negative if every motion exceeds its certificate.
    """

    low: float
    high: float
    count: int
    kept: Interval
    in_contact: int
    promised: float
    measured: float
    worst: float


def pearson(a: ArrayLike, b: ArrayLike) -> float | None:
    """Compute Pearson's correlation of two rows (P,) of numbers.

    Returns:
        The coefficient, or None for fewer than two numbers or for a constant row.
    """
    x, y = _pair(a, b)
    if len(x) < 2:
        return None
    x, y = x - x.mean(), y - y.mean()
    length = float(np.linalg.norm(x) * np.linalg.norm(y))
    # Rounding: the mean of equal numbers may differ from them in the last bit.
    if length <= 1e-12:
        return None
    return float(np.clip(x @ y / length, -1.0, 1.0))


def mean_maximum_rank_violation(simulated: ArrayLike, real: ArrayLike) -> float | None:
    """Compute SIMPLER's MMRV (Li et al. 2024, eq. 1).

    MMRV = 1/P Σ_i max_j |real_i - real_j| · [sim_i < sim_j ≠ real_i < real_j]. 0 is best and 1 is worst.

    Args:
        simulated: (P,) success rates in the evaluated simulation.
        real: (P,) success rates in the reference.

    Returns:
        The measure, or None without policies.
    """
    sim, truth = _pair(simulated, real)
    if not len(sim):
        return None
    violated = (sim[:, None] < sim[None]) != (truth[:, None] < truth[None])
    return float((np.abs(truth[:, None] - truth[None]) * violated).max(axis=1).mean())


def wilson(successes: int, trials: int) -> Interval:
    """Compute a success rate with Wilson's score interval (Wilson 1927), which is also valid for rates 0 and 1."""
    if trials < 1:
        return Interval(None, None, None, "no trials")
    p, z2 = successes / trials, _Z**2
    middle = (p + z2 / (2 * trials)) / (1 + z2 / trials)
    half = _Z * float(np.sqrt(p * (1 - p) / trials + z2 / (4 * trials**2))) / (1 + z2 / trials)
    return Interval(p, min(p, max(0.0, middle - half)), max(p, min(1.0, middle + half)))  # rounded at 0 and 1


def agreement(
    names: Sequence[str],
    in_map: ArrayLike,
    in_held_out: ArrayLike,
    refused: ArrayLike | None = None,
    *,
    resamples: int = 2000,
    seed: int = 0,
) -> Agreement:
    """Compute scores of P policies over T trials, which are the same for all policies and both twins.

    Intervals are percentiles over resampled trials (Efron and Tibshirani 1993, ch. 13): the results of one trial are
    drawn together. The same seed gives the same intervals.

    Args:
        names: of the policies.
        in_map, in_held_out: (P, T) bool, success.
        refused: (P, T) bool, whether the policy returned no motion.
        resamples: number of bootstrap resamples.
        seed: of the resampling.

    Raises:
        InputError: shapes do not fit, or there is no policy or no trial.
    """
    a, b = (np.asarray(x, dtype=np.bool_) for x in (in_map, in_held_out))
    no_motion = np.zeros_like(a) if refused is None else np.asarray(refused, dtype=np.bool_)
    if a.ndim != 2 or a.shape != b.shape or a.shape != no_motion.shape or len(names) != len(a) or not a.size:
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
            int(no_motion[i].sum()),
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
    in_contact: ArrayLike,
    edges: Sequence[float] = (0.0, 0.005, 0.01, 0.02, 0.05, np.inf),
) -> tuple[ReliabilityRow, ...]:
    """Compare certified with simulated clearance in bins; empty bins are left out.

    Args:
        promised, measured: (M,) certified and simulated clearance [m] of each motion.
        in_contact: (M,) bool.
        edges: of the bins [m], ascending.
    """
    p, m = _pair(promised, measured)
    hit = np.asarray(in_contact, dtype=np.bool_)
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
