"""Sim-to-sim: policies that use only the map, evaluated in the map's twin and in a held-out twin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.results.metrics import without_nan
from splatbot.sim.compare.agreement import Agreement, ReliabilityRow, agreement, reliability
from splatbot.sim.motion import JointMotion
from splatbot.sim.twin import Twin, TwinResult

KIND = "sim-to-sim"

Case = TypeVar("Case")
CaseIn = TypeVar("CaseIn", contravariant=True)


@dataclass(frozen=True, eq=False)
class PolicyAction:
    """Motion of a policy.

    Args:
        motion: of the arm.
        promised: certified clearance [m]. If None, the motion is not certified.
    """

    motion: JointMotion
    promised: float | None = None


class Policy(Protocol[CaseIn]):
    """Chooses a motion from the map alone; equal cases give equal motions, which both twins then follow."""

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    def act(self, case: CaseIn) -> PolicyAction | None:
        """Return the motion for a case, or None if the policy refuses."""
        ...


class PolicyTask(Protocol[Case]):
    """A task with its cases and its success criterion."""

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    @property
    def cases(self) -> Sequence[Case]:
        """One case for each trial."""
        ...

    def twins(self, case: Case) -> tuple[Twin, Twin]:
        """Return the twin of the map and the held-out twin."""
        ...

    def failure(self, case: Case, twin: Twin, result: TwinResult) -> str:
        """Return the reason why the motion that a twin has just followed failed; empty after success."""
        ...


@dataclass(frozen=True, eq=False)
class MapTask(Generic[Case]):
    """The common part of tasks with one twin of the map.

    Args:
        cases: one for each trial.
        map_twin: of the map; the same for all cases.
        held_out: creates the held-out twin of a case.
    """

    cases: Sequence[Case]
    map_twin: Twin
    held_out: Callable[[Case], Twin]

    def twins(self, case: Case) -> tuple[Twin, Twin]:
        """Implement :meth:`PolicyTask.twins`."""
        return self.map_twin, self.held_out(case)


@dataclass(frozen=True)
class Trial:
    """Result of a policy in one case.

    Args:
        policy, case: name and number.
        refused: whether the policy returned no motion.
        in_map, in_held_out: success.
        promised: certified clearance [m]. If None, the motion is not certified.
        clearance_map, clearance_held_out: minimum simulated clearance of the arm [m], or None without a motion.
        in_contact: whether the arm had a contact in the held-out twin.
        why_map, why_held_out: reason of the failure; empty after success.
    """

    policy: str
    case: int
    refused: bool
    in_map: bool
    in_held_out: bool
    promised: float | None = None
    clearance_map: float | None = None
    clearance_held_out: float | None = None
    in_contact: bool = False
    why_map: str = ""
    why_held_out: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the trial as values for JSON."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class TrialResults:
    """All trials of a task.

    Args:
        task: its name.
        policies: their names.
        trials: of every policy in every case that was done.
        interrupted: whether the user stopped the trials.
    """

    task: str
    policies: tuple[str, ...]
    trials: tuple[Trial, ...]
    interrupted: bool = False
    seed: int = 0

    @property
    def cases(self) -> tuple[int, ...]:
        """Cases in which every policy was tried."""
        return tuple(sorted({trial.case for trial in self.trials}))

    def agreement(self) -> Agreement | None:
        """Compute the agreement of the twins on the policies, or None before the first case."""
        if not self.trials:
            return None
        rows = [self._column(name) for name in ("in_map", "in_held_out", "refused")]
        return agreement(self.policies, *rows, seed=self.seed)

    def reliability(self) -> tuple[ReliabilityRow, ...]:
        """Compare certified clearance with that simulated in the held-out twin."""
        made = [t for t in self.trials if t.promised is not None and t.clearance_held_out is not None]
        return reliability(
            [t.promised or 0.0 for t in made], [t.clearance_held_out or 0.0 for t in made], [t.in_contact for t in made]
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the results as values for JSON."""
        found = self.agreement()
        return without_nan(
            {
                "kind": KIND,
                "task": self.task,
                "cases": len(self.cases),
                "agreement": None if found is None else asdict(found),
                "reliability": [asdict(row) for row in self.reliability()],
                "trials": [trial.to_dict() for trial in self.trials],
                "interrupted": self.interrupted,
            }
        )

    def _column(self, name: str) -> NDArray[np.bool_]:
        found = {(t.policy, t.case): getattr(t, name) for t in self.trials}
        return np.array([[found[policy, case] for case in self.cases] for policy in self.policies], np.bool_)


def run_trials(
    task: PolicyTask[Case],
    policies: Sequence[Policy[Case]],
    *,
    seed: int = 0,
    on_progress: Callable[[str, float], None] = lambda step, share: None,
) -> TrialResults:
    """Run every policy in every case, each motion in both twins. Ctrl-C ends the trials and keeps complete cases.

    Raises:
        InputError: two policies have the same name, or there are no policies.
    """
    names = tuple(policy.name for policy in policies)
    if not names or len(set(names)) < len(names):
        raise InputError(f"are {', '.join(names) or 'none'}.", field="policies", hint="give each a unique name")
    done: list[Trial] = []
    interrupted = False
    try:
        for number, case in enumerate(task.cases):
            on_progress(f"{task.name}, case {number + 1} of {len(task.cases)}", number / len(task.cases))
            in_map, held_out = task.twins(case)
            done += [_trial(task, policy, case, number, in_map, held_out) for policy in policies]
    except KeyboardInterrupt:
        interrupted = True
    return TrialResults(task.name, names, tuple(done), interrupted, seed)


def _trial(
    task: PolicyTask[Case], policy: Policy[Case], case: Case, number: int, in_map: Twin, held_out: Twin
) -> Trial:
    attempt = policy.act(case)
    if attempt is None:
        return Trial(policy.name, number, True, False, False, why_map="refused", why_held_out="refused")
    believed = in_map.follow(attempt.motion)
    why_map = task.failure(case, in_map, believed)
    found = held_out.follow(attempt.motion)
    why_held_out = task.failure(case, held_out, found)
    return Trial(
        policy=policy.name,
        case=number,
        refused=False,
        in_map=not why_map,
        in_held_out=not why_held_out,
        promised=attempt.promised,
        clearance_map=believed.clearance.value,
        clearance_held_out=found.clearance.value,
        in_contact=bool(found.contacts),
        why_map=why_map,
        why_held_out=why_held_out,
    )


def join(a: TrialResults, b: TrialResults) -> TrialResults:
    """Join two results of one task; the cases of ``b`` follow those of ``a``.

    Raises:
        InputError: the policies or tasks differ.
    """
    if a.policies != b.policies or a.task != b.task:
        raise InputError("are of different tasks or policies.", field="results", hint="join results of one task")
    after = 1 + max(a.cases, default=-1)
    later = tuple(replace(trial, case=trial.case + after) for trial in b.trials)
    return TrialResults(a.task, a.policies, (*a.trials, *later), a.interrupted or b.interrupted, a.seed)
