"""Reliability of grasps: bins, the logistic fit against a known law, and the plot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.grasping.reliability import ExecutedGrasp, add_reliability, fit_logistic, plot_reliability
from splatbot.bench.results import Results


def rows(count: int = 400) -> list[ExecutedGrasp]:
    """Return grasps that succeed as often as they say."""
    rng = np.random.default_rng(0)
    sure = rng.uniform(0, 1, count)
    return [ExecutedGrasp(k, float(p), float(p), bool(rng.uniform() < p)) for k, p in enumerate(sure)]


def test_the_fit_recovers_a_known_law_and_stays_finite_where_all_succeed() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 1, 20_000)
    success = (rng.uniform(size=len(x)) < 1 / (1 + np.exp(-(6.0 * x - 2.0)))).astype(float)
    slope, offset = fit_logistic(x, success)
    assert slope == pytest.approx(6.0, abs=0.3)
    assert offset == pytest.approx(-2.0, abs=0.15)
    assert np.isfinite(fit_logistic(x[:50], np.ones(50))).all()


def test_bins_hold_every_grasp_once_and_calibrated_ones_agree() -> None:
    results = Results({})
    add_reliability(results, rows())
    counts = [row.value for row in results.select("confidence ") if row.metric == "grasps"]
    assert sum(count or 0.0 for count in counts) == 400
    for row in results.select("confidence "):
        if row.metric == "succeeded":
            mean = results.find(row.case, "confidence, mean")
            assert row.value == pytest.approx(mean, abs=0.15)
    assert (results.find("all grasps", "difference") or 0.0) < 0.06


def test_no_grasp_gives_empty_bins_and_no_plot_is_wrong(tmp_path: Path) -> None:
    empty = Results({})
    add_reliability(empty, [])
    assert empty.find("all grasps", "grasps") is None
    full = Results({})
    add_reliability(full, rows())
    plot_reliability(full, tmp_path)
    assert (tmp_path / "reliability.png").stat().st_size > 5_000
