"""Computation time of each effect in a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from splatbot.sim.effects.physics import PHYSICS, physics_effect
from splatbot.sim.effects.registry import effect_class
from splatbot.sim.motion import JointMotion
from splatbot.sim.twin import Twin, TwinResult


@dataclass(frozen=True)
class LedgerEntry:
    """One effect in a run.

    Args:
        name: of the effect.
        on: whether it was active.
        why: reason for or against it.
        by: origin of the decision: the scene's content, or `forced`, `forbidden`.
        observable: result or property of the frames that the effect changes; empty for an inactive sensor effect.
        ms: additional physics time with the effect [ms], negative if it saves time, or time of a sensor effect. It is
            undefined (None) if the effect was inactive or not measured.
        us_per_step: the same per step [us].
    """

    name: str
    on: bool
    why: str
    by: str
    observable: str
    ms: float | None
    us_per_step: float | None


def ledger(
    twin: Twin,
    result: TwinResult,
    motion: JointMotion | None = None,
    *,
    costs: bool = True,
    sensor: Sequence[Mapping[str, Any]] = (),
) -> list[LedgerEntry]:
    """Return an entry for every effect; an active physics effect is measured by a second run without it.

    Args:
        twin: that ran.
        result: of that run.
        motion: that it followed.
        costs: whether to measure, with one run for each active physics effect.
        sensor: report of the camera, see :meth:`TwinCamera.report`.
    """
    drawn = {row["name"]: (row["ms_per_frame"] or 0.0) * row["frames"] for row in sensor}
    base = twin.follow(motion).physics_seconds if costs else 0.0  # a separate run, because callbacks cost time
    found = []
    for decision in result.decisions:
        physical = decision.name in PHYSICS
        if physical:
            ms = _cost(twin, result, motion, decision.name, base) if costs and decision.on else None
        else:
            ms = drawn.get(decision.name)
        each = None if ms is None else 1e3 * ms / max(1, result.steps)
        observable = _observable(decision.name) if physical or decision.on else ""
        found.append(LedgerEntry(decision.name, decision.on, decision.why, decision.by, observable, ms, each))
    return found


def _observable(name: str) -> str:
    if name in PHYSICS:
        return physics_effect(name).observable
    return str(effect_class(name).observable)


def _cost(twin: Twin, result: TwinResult, motion: JointMotion | None, name: str, base: float) -> float:
    without = Twin(
        twin.scene.with_effects(forbid=(name,)), robot=twin.world.robot, timestep=twin.timestep, seed=twin.seed
    )
    steps = without.follow(motion)
    return 1e3 * (base - steps.physics_seconds * result.steps / max(1, steps.steps))
