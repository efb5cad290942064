"""OMPL's planners on the field, on a mesh and on an octree of the same scene; VAMP where it is installed."""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from splatbot.bench.benchmark import ReportProgress
from splatbot.bench.collision.peers import mesh_checker, octree_checker
from splatbot.bench.planning_problems import Problem
from splatbot.bench.results import Results
from splatbot.bench.tabletop import Tabletop
from splatbot.bench.truth import Truth
from splatbot.collision import RobotSpheres
from splatbot.planning import GaussianRRTStar
from splatbot.protocols import Array

Audit = Callable[[Sequence[Array], RobotSpheres, Truth], tuple[Array, int]]
IMPROVING = ("AORRTC", "BITstar", "RRTstar")
RESOLUTION = 1 / 32  # [rad] between the states of an edge, where OMPL checks states


def run_peers(
    results: Results,
    scene: Tabletop,
    planner: GaussianRRTStar,
    wanted: Sequence[Problem],
    budgets_ms: Sequence[float],
    ours: Mapping[float, Array],
    audit: Audit,
    truth: Truth,
    report_progress: ReportProgress,
) -> None:
    """Measure the peers: first paths, and costs over budgets of those that improve a path."""
    missing = importlib.util.find_spec("vamp") is None
    note = "absent: vamp is not installed (it has no wheel)" if missing else "not driven by this benchmark"
    results.add("first path", "time, median", None, "ms", peer="VAMP", note=note)
    if importlib.util.find_spec("ompl") is None:
        results.add("first path", "time, median", None, "ms", peer="OMPL", note="absent: ompl is not installed")
        return
    arm = planner.arm
    motion = _certified_edges(planner)
    checks: list[tuple[str, Callable[[Array], bool], Callable[[Array, Array], bool] | None]] = [
        ("OMPL RRTConnect, field, certified edges", _field_states(planner), motion),
        ("OMPL RRTConnect, field, states every 1/32 rad", _field_states(planner), None),
    ]
    for name, make in (("coal mesh", mesh_checker), ("octree of 1 cm", octree_checker)):
        try:
            checks.append((f"OMPL RRTConnect, {name}", _solid_states(arm, make(scene)), None))
        except ImportError as error:
            results.add("first path", "time, median", None, "ms", peer=name, note=f"absent: {error}")
    for name, states, edges in checks:
        report_progress(name)
        _first_paths(results, name, _Ompl(arm, states, edges), wanted, audit, truth)
    problem = _Ompl(arm, _field_states(planner), motion)
    for planner_name in IMPROVING:
        for budget in budgets_ms:
            report_progress(f"OMPL {planner_name}, {budget:g} ms")
            found = [problem.solve(planner_name, p, 1e-3 * budget) for p in wanted]
            cost = np.array([np.nan if path is None else _length(path) for path, _ in found])
            name = f"OMPL {planner_name}, field"
            case = f"budget {budget:g} ms"
            results.add(case, "solved", float(np.isfinite(cost).sum()), f"of {len(wanted)}", peer=name)
            if np.isfinite(cost).any():
                results.add(case, "cost, mean", float(np.nanmean(cost)), "rad", peer=name)
            for own, costs in ours.items():
                add_ratio(results, f"budget {own:g} ms against its {budget:g} ms", costs, cost, name)


def add_ratio(results: Results, case: str, ours: Array, theirs: Array, peer: str) -> None:
    """Add the mean of the paired ratios ours / theirs over problems that both solved, with its 95 % interval."""
    both = np.isfinite(ours) & np.isfinite(theirs)
    if both.sum() < 2:
        return
    ratio = ours[both] / theirs[both]
    half = float(stats.t.ppf(0.975, len(ratio) - 1) * stats.sem(ratio))
    results.add(case, "paired ratio of costs, mean", float(ratio.mean()), "x", peer=peer)
    results.add(case, "its 95 % interval, +-", half, "x", peer=peer)
    results.add(case, "paired ratio, largest", float(ratio.max()), "x", peer=peer)


def _first_paths(
    results: Results, name: str, problem: _Ompl, wanted: Sequence[Problem], audit: Audit, truth: Truth
) -> None:
    found = [problem.solve("RRTConnect", p, 2.0) for p in wanted]
    paths = [path for path, _ in found if path is not None]
    results.add("first path", "solved", float(len(paths)), f"of {len(wanted)}", peer=name)
    walls = [1e3 * spent for _, spent in found]
    results.add("first path", "time, median", float(np.median(walls)), "ms", peer=name)
    results.add("first path", "time, 95 %", float(np.percentile(walls, 95)), "ms", peer=name)
    if not paths:
        return
    results.add("first path", "cost, mean", float(np.mean([_length(path) for path in paths])), "rad", peer=name)
    clearances, own = audit(paths, problem.arm, truth)
    results.add(
        "first path", "in contact with the true shapes", float((clearances <= 0).sum()), f"of {len(paths)}", peer=name
    )
    results.add("first path", "deepest", 1e3 * max(0.0, -float(clearances.min())), "mm", peer=name)
    results.add("first path", "in self-collision", float(own), f"of {len(paths)}", peer=name)


def _length(path: Array) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _field_states(planner: GaussianRRTStar) -> Callable[[Array], bool]:
    check, field = planner.arm.native.configurations, planner.field.native
    return lambda q: bool(check(field, q)[0] < 0)


def _certified_edges(planner: GaussianRRTStar) -> Callable[[Array, Array], bool]:
    certify, field, eps = planner.arm.native.certify, planner.field.native, planner.eps
    return lambda a, b: bool(certify(field, a, b, eps)[0][0] < 0)


def _solid_states(arm: RobotSpheres, check: Callable[[Array, Array], list[bool]]) -> Callable[[Array], bool]:
    moving = arm.spheres.link > 0
    radii = arm.spheres.radii[moving]
    own = arm.native.configurations

    def free(q: Array) -> bool:
        return bool(own(None, q)[0] < 0) and not check(arm.centers(q)[:, moving], radii)[0]

    return free


class _Ompl:
    """OMPL set up for an arm: states by ``states``, edges by ``edges`` or by states every 1/32 rad."""

    def __init__(
        self, arm: RobotSpheres, states: Callable[[Array], bool], edges: Callable[[Array, Array], bool] | None
    ) -> None:
        importlib.import_module("ompl.util").setLogLevel(importlib.import_module("ompl.util").LOG_ERROR)
        self.arm = arm
        self._base, self._geometric = importlib.import_module("ompl.base"), importlib.import_module("ompl.geometric")
        self._states, self._edges = states, edges
        chain = arm.robot.chain
        self._joints = len(chain)
        self._space = self._base.RealVectorStateSpace(self._joints)
        bounds = self._base.RealVectorBounds(self._joints)
        for j in range(self._joints):
            bounds.setLow(j, float(chain.lower[j]))
            bounds.setHigh(j, float(chain.upper[j]))
        self._space.setBounds(bounds)

    def solve(self, planner: str, problem: Problem, seconds: float) -> tuple[Array | None, float]:
        """Return the waypoints (N, J) and the time [s]. If the waypoints are None, the time was not enough."""
        setup = self._geometric.SimpleSetup(self._space)
        setup.setStateValidityChecker(lambda state: self._states(self._read(state)))
        information = setup.getSpaceInformation()
        information.setStateValidityCheckingResolution(RESOLUTION / self._space.getMaximumExtent())
        if self._edges is not None:
            validator = self._validator(information, self._edges)
            information.setMotionValidator(validator)
        setup.setStartAndGoalStates(self._state(problem.start), self._state(problem.goal))
        objective = self._base.PathLengthOptimizationObjective(information)
        objective.setCostThreshold(self._base.Cost(0.0))
        setup.setOptimizationObjective(objective)
        setup.setPlanner(getattr(self._geometric, planner)(information))
        setup.setup()
        begin = time.perf_counter()
        setup.solve(seconds)
        spent = time.perf_counter() - begin
        if not setup.haveExactSolutionPath():
            return None, spent
        path = setup.getSolutionPath()
        return np.concatenate([self._read(path.getState(i)) for i in range(path.getStateCount())]), spent

    def _validator(self, information: Any, edges: Callable[[Array, Array], bool]) -> Any:
        read = self._read

        class Certified(self._base.MotionValidator):  # type: ignore[name-defined]
            def checkMotion(self, a: Any, b: Any, *rest: Any) -> bool:
                return edges(read(a), read(b))

        return Certified(information)

    def _read(self, state: Any) -> Array:
        return np.array([[state[j] for j in range(self._joints)]])

    def _state(self, q: Array) -> Any:
        state = self._space.allocState()
        for j in range(self._joints):
            state[j] = float(q[j])
        return state
