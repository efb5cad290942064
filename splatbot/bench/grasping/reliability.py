"""Reliability of the confidence of grasps: the share of executed grasps that succeed in the held-out twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.grasping import GraspingSettings
from splatbot.bench.grasping.scenes import over_scenes
from splatbot.bench.machine import describe_machine
from splatbot.bench.plots import Panel, PlotCurve, Point, save_plot
from splatbot.bench.results import Results
from splatbot.grasping.affordance import AffordanceError
from splatbot.sim.compare.agreement import wilson
from splatbot.sim.trials.scan import UnseenError, scan_scene
from splatbot.sim.trials.scenes import make_trial
from splatbot.sim.trials.stacks import GaussianStack, decide
from splatbot.sim.trials.trial import Failure, attempt, held_out_twin

_GRASPS = 5  # of each scene, evenly spaced in the ranked list, so that worse ones are executed too
_EDGES = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)  # of the bins of confidence
_NOT_EXECUTED = (Failure.PLAN, Failure.IK)  # no path was found; that is no statement about the grasp


@dataclass(frozen=True)
class ExecutedGrasp:
    """A grasp that was executed, its confidence 0..1, its total score, and whether it succeeded."""

    seed: int
    confidence: float
    total: float
    success: bool


def run_reliability(settings: GraspingSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Execute up to five grasps in each of some scenes, and compare confidence with the share of successes."""
    results = Results(describe_machine((1,), peak_ms=settings.peak_ms))
    seeds = range(settings.first, settings.first + settings.reliability)
    rows = over_scenes(seeds, execute_grasps, "grasps", report_progress)
    add_reliability(results, rows)
    return results


def execute_grasps(seed: int) -> list[ExecutedGrasp]:
    """Execute up to five grasps of one scene, each in a new held-out twin."""
    trial = make_trial(seed, "tabletop")
    try:
        scan = scan_scene(trial)
        decision = decide(GaussianStack().learn(scan), scan.hints[trial.target])
    except (UnseenError, AffordanceError):
        return []
    grasps = (*decision.grasps.grasps, *decision.grasps.doubtful)
    rows = []
    for k in np.unique(np.linspace(0, len(grasps) - 1, min(_GRASPS, len(grasps))).round().astype(int)):
        one = replace(decision, grasps=replace(decision.grasps, grasps=(grasps[k],)))
        result, _ = attempt(one, trial, held_out_twin(trial))
        if result.failure not in _NOT_EXECUTED:
            rows.append(ExecutedGrasp(seed, grasps[k].confidence, grasps[k].total, result.success))
    return rows


def add_reliability(results: Results, rows: Sequence[ExecutedGrasp]) -> None:
    """Add a row for each bin of confidence, and the logistic fit of all grasps."""
    sure, held = np.array([row.confidence for row in rows]), np.array([row.success for row in rows], np.float64)
    for low, high in pairwise(_EDGES):
        inside = (sure >= low) & ((sure < high) | (high == 1.0))
        case = f"confidence {low:g} to {high:g}"
        results.add(case, "grasps", float(inside.sum()), "")
        if inside.any():
            results.add(case, "confidence, mean", float(sure[inside].mean()), "")
            results.add(case, "succeeded", float(held[inside].mean()), "")
    if len(rows):
        error = float(abs(sure.mean() - held.mean()))
        results.add("all grasps", "grasps", float(len(rows)), "")
        results.add("all grasps", "confidence, mean", float(sure.mean()), "")
        results.add("all grasps", "succeeded", float(held.mean()), "")
        results.add("all grasps", "difference", error, "")
        slope, offset = fit_logistic(np.array([row.total for row in rows]), held)
        results.add("logistic fit of these grasps", "slope", slope, "")
        results.add("logistic fit of these grasps", "offset", offset, "")


def fit_logistic(x: np.ndarray, success: np.ndarray, steps: int = 100) -> tuple[float, float]:
    """Fit P(success) = 1 / (1 + exp(-(slope x + offset))) by Newton's method, with a weak prior on both (σ = 30)."""
    A, w = np.c_[x, np.ones(len(x))], np.zeros(2)
    for _ in range(steps):
        p = 1 / (1 + np.exp(-A @ w))
        gradient = A.T @ (p - success) + w / 30.0**2
        step = np.linalg.solve(A.T @ (A * (p * (1 - p))[:, None]) + np.eye(2) / 30.0**2, gradient)
        w = w - step / max(1.0, float(np.abs(step).max()) / 5.0)
        if np.abs(step).max() < 1e-9:
            break
    return float(w[0]), float(w[1])


def plot_reliability(results: Results, folder: Path) -> None:
    """Draw the share of successes over confidence, with 95 % intervals (Wilson 1927) and the diagonal."""
    bins: dict[str, dict[str, float]] = {}
    for row in results.rows:
        if row.case.startswith("confidence ") and row.value is not None:
            bins.setdefault(row.case, {})[row.metric] = row.value
    points = []
    for found in bins.values():
        if "succeeded" in found:
            n, y = found["grasps"], found["succeeded"]
            interval = wilson(round(y * n), round(n))
            points.append(Point(found["confidence, mean"], y, f"{n:.0f}", low=interval.low, high=interval.high))
    curves = [
        PlotCurve("calibrated", [Point(0.0, 0.0), Point(1.0, 1.0)], "reference"),
        PlotCurve("grasps (simulated), with their number", points, "points"),
    ]
    panel = Panel("Reliability of grasps", "stated confidence", "share of successes", curves)
    save_plot([panel], folder, "reliability")
