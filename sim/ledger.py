"""What each effect cost a run."""

from __future__ import annotations

from dataclasses import dataclass

from splatbot.sim.effects.physics import physics_effect
from splatbot.sim.motion import JointMotion
from splatbot.sim.twin import Twin, TwinResult


@dataclass(frozen=True)
class Entry:
    """One effect in a run.

    Args:
        name: of the effect.
        on: whether it was.
        why: or why not.
        by: the scene's content, or `forced`, `forbidden`.
        observable: the figure that changes without it.
        ms: how much longer physics took with it than without it [ms]; None if it was off, or was not measured.
            Below 0 it saved time.
        us_per_step: the same for a step [us].
    """

    name: str
    on: bool
    why: str
    by: str
    observable: str
    ms: float | None
    us_per_step: float | None


def ledger(twin: Twin, result: TwinResult, motion: JointMotion | None = None, *, costs: bool = True) -> list[Entry]:
    """An entry for every effect; each that is on is measured by running the motion again without it.

    Args:
        twin: that ran.
        result: of that run.
        motion: that it followed.
        costs: whether to measure; takes a run for each effect that is on.
    """
    base = twin.follow(motion).physics_seconds if costs else 0.0  # again: the run itself may have been watched
    found = []
    for decision in result.decisions:
        ms = _cost(twin, result, motion, decision.name, base) if costs and decision.on else None
        each = None if ms is None else 1e3 * ms / max(1, result.steps)
        observable = physics_effect(decision.name).observable
        found.append(Entry(decision.name, decision.on, decision.why, decision.by, observable, ms, each))
    return found


def _cost(twin: Twin, result: TwinResult, motion: JointMotion | None, name: str, base: float) -> float:
    without = Twin(
        twin.scene.with_effects(forbid=(name,)), robot=twin.world.robot, timestep=twin.timestep, seed=twin.seed
    )
    steps = without.follow(motion)
    return 1e3 * (base - steps.physics_seconds * result.steps / max(1, steps.steps))
