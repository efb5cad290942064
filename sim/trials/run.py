"""Simulated trials in parallel processes; each result is written when it is complete, and is not computed again."""

from __future__ import annotations

import importlib.util
import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from splatbot.errors import FormatError, InputError, SplatbotError
from splatbot.sim.picking import MOST_MOVED
from splatbot.sim.trials.scenes import FAMILIES, make_trial
from splatbot.sim.trials.stacks import GaussianStack, LookingStack, Stack
from splatbot.sim.trials.trial import VERSION, TrialRow, run_trial

FILE = "trials.jsonl"
STACKS = ("gaussians", "gaussians_look", "mesh", "cloud")
OnProgress = Callable[[str, float], None]


class TrialError(SplatbotError):
    """A trial ended by an error of the program, which is no result about the grasp."""


@dataclass(frozen=True)
class TrialsPlan:
    """Trials to run.

    Args:
        family: of :data:`splatbot.sim.trials.scenes.FAMILIES`.
        trials: number of seeds, from ``first`` on.
        stacks: names of :data:`STACKS`.
        first: first seed.
        jobs: number of processes.
        frames, width: of each scan.
        videos: whether to record videos of failures.
        moved: distance by which the target is pushed aside after the scan [m].

    Raises:
        InputError: a value is out of range, or a name unknown.
    """

    family: str = "tabletop"
    trials: int = 50
    stacks: tuple[str, ...] = ("gaussians",)
    first: int = 0
    jobs: int = 1
    frames: int = 32
    width: int = 320
    videos: bool = False
    moved: float = 0.0

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise InputError(f"is {self.family!r}.", field="scenes", hint=f"one of {', '.join(FAMILIES)}")
        unknown = [name for name in self.stacks if name not in STACKS]
        if unknown or not self.stacks:
            raise InputError(f"are {', '.join(self.stacks) or 'none'}.", field="stacks", hint=f"of {', '.join(STACKS)}")
        if not 0.0 <= self.moved <= MOST_MOVED:
            raise InputError(f"is {self.moved:g}.", field="moved", hint=f"give metres, 0 to {MOST_MOVED:g}")
        if self.trials < 1 or self.jobs < 1 or self.first < 0 or self.frames < 4 or self.width < 64:
            hint = "give 1 trial and job or more, a seed of 0 or more, 4 frames of 64 pixels or more"
            raise InputError("is out of range.", field="plan", hint=hint)

    @property
    def seeds(self) -> range:
        """Seeds in their order."""
        return range(self.first, self.first + self.trials)


def stack_of(name: str) -> Stack:
    """Return a stack by its name.

    Raises:
        InputError: python-fcl, which the other stacks need, is not installed.
    """
    if name == "gaussians":
        return GaussianStack()
    if name == "gaussians_look":
        return LookingStack()
    if importlib.util.find_spec("fcl") is None:
        raise InputError("needs python-fcl.", field=f"stack {name}", hint="pip install python-fcl")
    from splatbot.sim.trials.peers import CloudStack, MeshStack

    return MeshStack() if name == "mesh" else CloudStack()


def run_trials(
    plan: TrialsPlan, folder: Path, *, on_progress: OnProgress = lambda step, share: None
) -> tuple[list[TrialRow], bool]:
    """Run all trials of a plan that ``folder`` does not contain yet.

    Returns:
        The rows of the plan in the order of seeds and stacks, and whether Ctrl-C ended it early.

    Raises:
        FormatError: the file in the folder is damaged.
        TrialError: a trial failed; earlier results are in the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FILE
    # Rows of another version, scan resolution or push belong to other trials, and stay in the file.
    own = (plan.frames, plan.width, plan.moved, VERSION)
    same = (row for row in read_rows(path) if (row.frames, row.pixels, row.moved, row.version) == own)
    done = {(row.family, row.seed, row.stack): row for row in same}
    for name in plan.stacks:
        stack_of(name)
    pending = [(seed, tuple(n for n in plan.stacks if (plan.family, seed, n) not in done)) for seed in plan.seeds]
    pending = [(seed, names) for seed, names in pending if names]
    interrupted = False
    count = len(plan.seeds) - len(pending)
    try:
        with path.open("a", encoding="utf-8") as file:
            for rows in _results(plan, folder, pending):
                for row in rows:
                    done[row.family, row.seed, row.stack] = row
                    file.write(json.dumps(row.to_dict()) + "\n")
                file.flush()
                count += 1
                on_progress(f"{plan.family}, {count} of {len(plan.seeds)} scenes", count / len(plan.seeds))
    except KeyboardInterrupt:
        interrupted = True
    keys = ((plan.family, seed, name) for name in plan.stacks for seed in plan.seeds)
    return [done[key] for key in keys if key in done], interrupted


def read_rows(path: Path) -> list[TrialRow]:
    """Read the rows of a file, or none if it does not exist; an incomplete last line is removed.

    Raises:
        FormatError: a line before the last is no row.
    """
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    rows = []
    for k, line in enumerate(lines):
        try:
            rows.append(TrialRow.from_dict(json.loads(line)))
        except (json.JSONDecodeError, TypeError, KeyError) as error:
            if k == len(lines) - 1 and not text.endswith("\n"):
                path.write_text("".join(f"{whole}\n" for whole in lines[:-1]), encoding="utf-8")
                break
            raise FormatError(f"line {k + 1} is no trial ({error}).", file=path, hint="name another folder") from error
    return rows


def _results(
    plan: TrialsPlan, folder: Path, pending: Sequence[tuple[int, tuple[str, ...]]]
) -> Iterator[list[TrialRow]]:
    jobs = [(plan, str(folder), seed, names) for seed, names in pending]
    if plan.jobs == 1 or len(jobs) < 2:
        yield from map(_job, jobs)
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # for the new processes; their number is the user's choice
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(plan.jobs, len(jobs)), mp_context=context, initializer=begin_worker) as pool:
        futures = {pool.submit(_job, job) for job in jobs}
        try:
            while futures:
                ready, futures = wait(futures, return_when=FIRST_COMPLETED)
                for future in ready:
                    yield future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def begin_worker() -> None:
    """Limit a process to one thread, and end it when its parent ends, even if the parent was killed."""
    torch.set_num_threads(1)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _job(job: Any) -> list[TrialRow]:
    plan, folder, seed, names = job
    videos = Path(folder) if plan.videos else None
    stacks = [stack_of(name) for name in names]
    try:
        trial = make_trial(seed, plan.family)
        return run_trial(trial, stacks, frames=plan.frames, width=plan.width, videos=videos, moved=plan.moved)
    except Exception as error:
        hint = f"the trials before it are in {folder}; --scenes {plan.family} --first {seed} --trials 1 runs it alone"
        raise TrialError(f"failed: {error}", field=f"{plan.family}, seed {seed}", hint=hint) from error
