"""Sweep of the margin: the shares that it reports are those of the audited points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.planning.margin_sweep import CONSTANTS, plot_margins, sweep_margins
from splatbot.bench.planning_problems import Problem
from splatbot.bench.results import Results
from splatbot.collision import GaussianCollisionField
from splatbot.collision.audit import audit_surfaces
from splatbot.collision.confirmed import ConfirmedSpace
from splatbot.robots.panda import panda
from tests.unit.collision.oracle import gaussians


def test_missed_surface_falls_and_false_hits_rise_with_the_margin(tmp_path: Path) -> None:
    field = GaussianCollisionField(gaussians([[0.0, 0.0, 2.0]], 0.05))  # a ball of 10 cm, far from the arm
    ray = np.linspace(0.0, 0.02, 21)  # beyond its surface
    points = np.c_[np.zeros((21, 2)), 2.1 + ray]
    index = np.zeros(21, np.int64)
    space = ConfirmedSpace(points, np.ones(21), index, np.zeros((21, 2), np.int64), points, 21)
    results = Results({})
    start = np.array(panda().home)
    problem = Problem(start, start + 0.2)
    sweep_margins(results, "ball", audit_surfaces(field, space), field, np.eye(4), [problem], budget_ms=20.0)
    cases = [f"ball, margin {1e3 * margin:.0f} mm" for margin in CONSTANTS.margins]
    missed, hits, solved = (
        np.array([results.find(case, metric) for case in cases], np.float64)
        for metric in ("missed surface", "false hits", "solved")
    )
    expected = [100.0 * np.mean(ray > margin + 1e-5) for margin in CONSTANTS.margins]
    np.testing.assert_allclose(missed, expected, atol=5.0)
    np.testing.assert_allclose(missed + hits, 100.0, atol=5.0)  # the same points count as free here
    assert (solved == 100.0).all()
    assert results.find("ball, margin at confidence", "0.9") == pytest.approx(18.0, abs=0.1)
    plot_margins(results, tmp_path)
    assert (tmp_path / "planning-margins-ball.png").stat().st_size > 1000
