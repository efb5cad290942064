"""Stacks of a trial: the candidate that is picked."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatbot.grasping.affordance import AffordanceError, Hint, NameHint, Target
from splatbot.grasping.types import Grasp, GraspResult
from splatbot.sim.trials import stacks
from splatbot.sim.trials.scenes import TrialScene
from splatbot.sim.trials.stacks import StackDecision, choose

pytest.importorskip("mujoco")


def grasp(total: float, lift_blocked: str = "") -> Grasp:
    T, pair = np.eye(4), np.zeros((2, 3))
    return Grasp(T, 0.04, 0.06, pair, pair, "top", {}, total, 0.01, T, lift_blocked=lift_blocked)


def chosen(monkeypatch: pytest.MonkeyPatch, grasps: dict[str, tuple[Grasp, ...]]) -> str:
    """Return the kind of the chosen candidate; each kind has its grasps, and a kind without an entry is not found."""
    none: Any = None

    def decide(known: object, hint: Hint, *, looks: bool = False) -> StackDecision:
        assert isinstance(hint, NameHint)
        if hint.text not in grasps:
            raise AffordanceError("is not there.")
        target = Target(np.zeros(1, np.int64), None, hint.text, "test", 1.0)
        return StackDecision(target, none, GraspResult(target, grasps[hint.text], {}, None, 0, {}, 0), none, 1.0)

    monkeypatch.setattr(stacks, "decide", decide)
    kinds = ("lower", "upper", "other", "hidden")
    trial = TrialScene(none, "lower", "lower", 0, "bin", False, others={kind: kind for kind in kinds[1:]})
    scan: Any = SimpleNamespace(hints={kind: NameHint(kind) for kind in kinds})
    found, decision = choose(none, trial, scan)
    assert found.target == decision.target.label
    assert decision.seconds == len(grasps)  # of all candidates that were found
    return found.kind


def test_a_grasp_that_can_be_lifted_is_better_than_a_likelier_one_that_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    under = (grasp(0.9, "it cannot be lifted: the held object is 8 mm deep in object 1"), grasp(0.8, "the same"))
    assert chosen(monkeypatch, {"lower": under, "upper": (grasp(0.5),), "other": ()}) == "upper"
    assert chosen(monkeypatch, {"lower": (*under, grasp(0.6)), "upper": (grasp(0.5),)}) == "lower"


def test_without_a_lift_the_likeliest_grasp_is_tried_and_one_is_better_than_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    low, high = (grasp(0.5, "it cannot be lifted"),), (grasp(0.9, "it cannot be lifted"),)
    assert chosen(monkeypatch, {"lower": low, "upper": high, "other": ()}) == "upper"
    assert chosen(monkeypatch, {"other": (), "lower": (), "upper": low}) == "upper"


def test_if_no_candidate_is_found_the_error_is_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(AffordanceError, match="is not there"):
        chosen(monkeypatch, {})
