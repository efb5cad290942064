"""Sim-to-sim: policies that see only the map, tried in the map's twin and in a held-out one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol, TypeVar

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
    """What a policy does.

    Args:
        motion: of the arm.
        promised: clearance from everything [m] that the policy answers for; None: it promises nothing.
    """

    motion: JointMotion
    promised: float | None = None


class Policy(Protocol[CaseIn]):
    """Decides on a motion from the map alone; the same case gives the same motion, which both twins then follow."""

    @property
    def name(self) -> str:
        """As tables have it."""
        ...

    def act(self, case: CaseIn) -> PolicyAction | None:
        """The motion for a case; None: the policy refuses."""
        ...


class PolicyTask(Protocol[Case]):
    """What is to be done, in cases that differ, and whether it was."""

    @property
    def name(self) -> str:
        """As tables have it."""
        ...

    @property
    def cases(self) -> Sequence[Case]:
        """One for each trial."""
        ...

    def twins(self, case: Case) -> tuple[Twin, Twin]:
        """The twin of the map and the held-out twin."""
        ...

    def failure(self, case: Case, twin: Twin, result: TwinResult) -> str:
        """Why a motion that a twin has just followed did not do it, in a few words; empty if it did."""
        ...


@dataclass(frozen=True)
class Trial:
    """A policy in one case.

    Args:
        policy, case: which.
        refused: there was no motion.
        in_map, in_held_out: success.
        promised: clearance [m]; None: nothing was promised.
        room_map, room_held_out: least room around the arm [m]; None without a motion.
        touched: whether the arm touched anything in the held-out twin.
        why_map, why_held_out: what went wrong there, in words; empty after success.
    """

    policy: str
    case: int
    refused: bool
    in_map: bool
    in_held_out: bool
    promised: float | None = None
    room_map: float | None = None
    room_held_out: float | None = None
    touched: bool = False
    why_map: str = ""
    why_held_out: str = ""


@dataclass(frozen=True, eq=False)
class TrialResults:
    """All trials of a task.

    Args:
        task: its name.
        policies: their names.
        trials: of every policy in every case that was done.
        interrupted: whether somebody stopped it.
    """

    task: str
    policies: tuple[str, ...]
    trials: tuple[Trial, ...]
    interrupted: bool = False
    seed: int = 0

    @property
    def cases(self) -> tuple[int, ...]:
        """Those in which every policy was tried."""
        return tuple(sorted({trial.case for trial in self.trials}))

    def agreement(self) -> Agreement | None:
        """How far the twins agree on the policies; None before the first case was done."""
        if not self.trials:
            return None
        rows = [self._column(name) for name in ("in_map", "in_held_out", "refused")]
        return agreement(self.policies, *rows, seed=self.seed)

    def reliability(self) -> tuple[ReliabilityRow, ...]:
        """Promised clearance against that in the held-out twin."""
        made = [t for t in self.trials if t.promised is not None and t.room_held_out is not None]
        return reliability(
            [t.promised or 0.0 for t in made], [t.room_held_out or 0.0 for t in made], [t.touched for t in made]
        )

    def to_dict(self) -> dict[str, Any]:
        """As JSON takes it."""
        found = self.agreement()
        return without_nan(
            {
                "kind": KIND,
                "task": self.task,
                "cases": len(self.cases),
                "agreement": None if found is None else asdict(found),
                "reliability": [asdict(row) for row in self.reliability()],
                "trials": [asdict(trial) for trial in self.trials],
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
    tell: Callable[[str, float], None] = lambda what, share: None,
) -> TrialResults:
    """Every policy in every case, each motion in both twins. Ctrl-C ends it with the cases that are whole.

    Raises:
        InputError: two policies have one name, or there is none.
    """
    names = tuple(policy.name for policy in policies)
    if not names or len(set(names)) < len(names):
        raise InputError(f"are {', '.join(names) or 'none'}.", field="policies", hint="give each a name of its own")
    done: list[Trial] = []
    interrupted = False
    try:
        for number, case in enumerate(task.cases):
            tell(f"{task.name}, case {number + 1} of {len(task.cases)}", number / len(task.cases))
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
        room_map=believed.near.room,
        room_held_out=found.near.room,
        touched=bool(found.touches),
        why_map=why_map,
        why_held_out=why_held_out,
    )


def join(a: TrialResults, b: TrialResults) -> TrialResults:
    """The trials of both, as of one task with the cases of the one after those of the other.

    Raises:
        InputError: they are of other policies.
    """
    if a.policies != b.policies or a.task != b.task:
        raise InputError("are of different tasks or policies.", field="results", hint="join what belongs together")
    after = 1 + max(a.cases, default=-1)
    later = tuple(replace(trial, case=trial.case + after) for trial in b.trials)
    return TrialResults(a.task, a.policies, (*a.trials, *later), a.interrupted or b.interrupted, a.seed)
