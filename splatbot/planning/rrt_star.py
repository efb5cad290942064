"""Planner: RRT-Connect finds a first path, shortcuts and RRT* improve it; all edges are certified."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot._native import ArmPlanner, path_clearance
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.robot import EPS
from splatbot.errors import InputError
from splatbot.planning.causes import blocked_line, collision, limit_violation
from splatbot.planning.goals import goal_configurations
from splatbot.planning.problem import (
    Cause,
    Certificate,
    Goal,
    Path,
    PlanningProblem,
    PlanResult,
    PlanStatus,
    StartError,
)
from splatbot.protocols import Array, RobotKinematics


@dataclass(frozen=True)
class RRTStarConstants:
    """Constants of the planner.

    Args:
        clearance_cut: [m] largest clearance of a certificate.
        postures_share: fraction of the budget for further postures once one reaches the pose.
        clearance_rounds: bisections of the clearance along a path, which resolve it to 2 %.
        certificate_reserve: [s] part of the budget that the certificate takes, at most a third of it.
        min_eps: [m] smallest eps, for a start or goal with hardly any clearance.
    """

    clearance_cut: float = 0.1
    postures_share: float = 0.25
    clearance_rounds: int = 6
    certificate_reserve: float = 7e-4
    min_eps: float = 4e-5


CONSTANTS = RRTStarConstants()


_STATUS = (None, PlanStatus.PLANNING_FAILED, PlanStatus.TIMED_OUT, PlanStatus.PREEMPTED)  # by native return code


class GaussianRRTStar:
    """Sampling-based planner of an arm among the Gaussians of one map version.

    Each edge of its trees is certified over its whole length against the map and against self-collision
    (:meth:`splatbot.collision.RobotSpheres.certify`). The search has three parts:

    1. RRT-Connect (Kuffner and LaValle, ICRA 2000) finds a first path; its two trees are then joined.
    2. RRT* (Karaman and Frazzoli, IJRR 2011) rewires the tree. Its samples come from the informed set
       ``|q - q_start| + |q - q_goal| <= c_best`` (Gammell et al., IROS 2014).
    3. Shortcuts of the best path, and further runs of RRT-Connect bounded by the best cost, speed this up.

    The cost is the length in joint space [rad]. Searches of several threads run one after another; the waiting time
    does not count towards their budgets.

    Args:
        field: collision field of the map.
        robot: the arm.
        T_world_base: (4, 4) pose of its base [m]. If None, the base is at the origin.
        opening: opening of the gripper [m]. If None, the gripper is fully open.
        attached: (A, 4) spheres (x, y, z, radius) [m] of a grasped object in the frame of the last link.
        margin: clearance that the arm keeps to the map [m]; it does not apply to self-collision.
        base_in_map: see :class:`splatbot.collision.RobotSpheres`.
        eps: clearance below which an edge is not certified [m].

    Raises:
        InputError: an argument is invalid, as for :class:`splatbot.collision.RobotSpheres`, or eps is below 4e-5 m.
    """

    def __init__(
        self,
        field: GaussianCollisionField,
        robot: RobotKinematics,
        *,
        T_world_base: ArrayLike | None = None,
        opening: float | None = None,
        attached: ArrayLike | None = None,
        margin: float = 0.0,
        base_in_map: bool = False,
        eps: float = EPS,
    ) -> None:
        if not CONSTANTS.min_eps <= eps < np.inf:
            raise InputError(f"is {eps}.", field="eps", hint=f"give metres, at least {CONSTANTS.min_eps:g}")
        self._field, self.robot, self.margin, self.eps = field, robot, margin, eps
        self.arm = RobotSpheres(
            robot,
            T_world_base=T_world_base,
            opening=opening,
            attached=attached,
            base_in_map=base_in_map,
            margin=margin,
        )
        self._eps = eps  # of the current problem
        self._native = self._planner(eps)
        self._goals: Array | None = None  # of the last search
        self._searching = threading.Lock()
        self._cancelled = threading.Event()  # kept until a search ends, for _prepare replaces the native planner

    @property
    def field(self) -> GaussianCollisionField:
        """Collision field; an assigned field applies to later searches."""
        return self._field

    @field.setter
    def field(self, field: GaussianCollisionField) -> None:
        with self._searching:
            self._set_field(field)

    def _set_field(self, field: GaussianCollisionField) -> None:
        self._field = field
        self._native.look_at(field.native)

    def plan(
        self,
        start: ArrayLike,
        goal: Goal | ArrayLike,
        *,
        budget_ms: float = 28.0,
        seed: int = 0,
        iterations: int | None = None,
    ) -> PlanResult:
        """Plan a path and improve it until the budget is used up.

        Args:
            start: (J,) configuration [rad or m].
            goal: see :mod:`splatbot.planning.problem`; an array (J,) or (K, J) is a set of configurations.
            budget_ms: time of the whole call, inverse kinematics and certificate included [ms].
            seed: seed of the samples.
            iterations: largest number of extensions of the trees. If they end the search, equal calls give equal paths.

        Returns:
            The best path with its certificate, or the cause of failure. Reaching the budget after a path is found is
            no failure.

        Raises:
            StartError: the start has a wrong shape or is not finite.
            GoalError: the goal has a wrong shape, is not finite or is invalid for this robot.
            InputError: budget_ms or iterations are not above 0.
        """
        _check_budget(budget_ms, iterations)
        with self._searching:
            return self._plan(start, goal, budget_ms, seed, iterations)

    def _plan(
        self, start: ArrayLike, goal: Goal | ArrayLike, budget_ms: float, seed: int, iterations: int | None
    ) -> PlanResult:
        begin = time.perf_counter()
        q = self._start(start)
        failed = self._check_start(q, begin)
        if failed is not None:
            return failed
        goals = goal_configurations(
            self.arm, self.field, goal, near=q, seed=seed, until=begin + CONSTANTS.postures_share * 1e-3 * budget_ms
        )
        if not len(goals.q):
            return self._failure(goals.status, goals.cause, goals.reason, begin)
        self._prepare(np.concatenate([q[None], goals.q]))
        self._goals = goals.q
        before = time.perf_counter() - begin
        left = _for_search(budget_ms, before)
        most = 2**62 if iterations is None else iterations
        end = self._search(lambda native: native.run(q, goals.q, left, most, seed, 0.0))
        return self._result(end, q, goals.q, before, begin, begin + 1e-3 * budget_ms)

    def solve(
        self, problem: PlanningProblem, *, budget_ms: float = 28.0, seed: int = 0, iterations: int | None = None
    ) -> PlanResult:
        """Call :meth:`plan` with the start and goal of a problem."""
        return self.plan(problem.start, problem.goal, budget_ms=budget_ms, seed=seed, iterations=iterations)

    def plan_again(
        self,
        field: GaussianCollisionField,
        before: GaussianCollisionField,
        start: ArrayLike,
        *,
        budget_ms: float = 10.0,
        seed: int = 0,
    ) -> PlanResult:
        """Plan again to the goals of the last :meth:`plan`, with its tree on a later field.

        The later field becomes :attr:`field`.

        Args:
            field: collision field of the later map.
            before: field that the tree was checked against; the edges are checked against the Gaussians added since.
            start: (J,) configuration [rad or m]. If it is not on the last path, a new tree is grown.
            budget_ms: time of the call [ms].
            seed: seed of the samples.

        Raises:
            StartError: the start has a wrong shape or is not finite.
            InputError: :meth:`plan` was not called before, the fields differ in n_sigma, or budget_ms is not above 0.
        """
        _check_budget(budget_ms, None)
        with self._searching:
            return self._plan_again(field, before, start, budget_ms, seed)

    def _plan_again(
        self,
        field: GaussianCollisionField,
        before: GaussianCollisionField,
        start: ArrayLike,
        budget_ms: float,
        seed: int,
    ) -> PlanResult:
        begin = time.perf_counter()
        if self._goals is None:
            raise InputError("was not called before.", field="plan", hint="plan first")
        self._set_field(field)
        q = self._start(start)
        failed = self._check_start(q, begin)
        if failed is not None:
            return failed
        goals = goal_configurations(self.arm, field, self._goals, near=q, seed=seed, until=begin)
        if not len(goals.q):
            return self._failure(goals.status, goals.cause, goals.reason, begin)
        added = field.added_since(before)
        spent = time.perf_counter() - begin
        left = _for_search(budget_ms, spent)
        arm = self.arm.without_pairs.native
        end = self._search(lambda native: native.rerun(q, field.native, added.native, arm, left, 2**62, seed))
        return self._result(end, q, goals.q, spent, begin, begin + 1e-3 * budget_ms)

    def clearance_to(self, field: GaussianCollisionField, waypoints: Array, cut: float, eps: float) -> float | None:
        """Return the clearance [m] of a path (N, J) from a field, at most ``cut``, or None if the path collides.

        Self-collision is not checked.
        """
        arm = self.arm.without_pairs
        if arm.certify(field, waypoints[:-1], waypoints[1:], eps=eps).in_collision.any():
            return None
        return float(
            path_clearance(arm.native, field.native, waypoints, max(cut, eps), CONSTANTS.clearance_rounds, np.inf)
        )

    def cancel(self) -> None:
        """End the search of another thread's :meth:`plan`, which returns the best path so far, or PREEMPTED.

        A cancel before the search begins ends it as well.
        """
        self._cancelled.set()
        self._native.cancel()

    def best(self) -> tuple[Array, float, NDArray[np.float64]]:
        """Return waypoints (N, J), cost [rad] and history (H, 2) of a running search; N is 0 before the first path.

        Any thread may call this.
        """
        waypoints, cost, history = self._native.best()
        return waypoints, float(cost), history

    def tree(self) -> tuple[Array, NDArray[np.int32], Array]:
        """Return nodes (N, J), parents (N,), -1 for the root, and costs from the root (N,) [rad] of the last search."""
        with self._searching:
            q, parent, cost = self._native.tree()
        return q, parent, cost

    @property
    def nbytes(self) -> int:
        """Memory of the tree of the last search [bytes]."""
        with self._searching:
            return int(self._native.bytes)

    def certificate(self, waypoints: Array, until: float = np.inf) -> Certificate:
        """Certify a path (N, J) and bound its clearance from below.

        Args:
            waypoints: (N, J) [rad or m].
            until: time of ``time.perf_counter`` at which the bound is no longer improved [s]. Without this limit the
                bound is tight to a few percent.
        """
        # The trees' edges were checked in their direction of growth; the reverse direction may round differently.
        for eps in (self._eps, self._eps / 4):
            if not self.arm.certify(self.field, waypoints[:-1], waypoints[1:], eps=eps).in_collision.any():
                left = until - time.perf_counter()
                clearance = path_clearance(
                    self.arm.native,
                    self.field.native,
                    waypoints,
                    CONSTANTS.clearance_cut,
                    CONSTANTS.clearance_rounds,
                    left,
                )
                return Certificate(True, eps, clearance, self.margin, self.field.map_version)
        return Certificate(False, self._eps, 0.0, self.margin, self.field.map_version)

    def _planner(self, eps: float) -> ArmPlanner:
        chain = self.robot.chain
        return ArmPlanner(self.arm.native, self.field.native, chain.lower, chain.upper, eps)

    def _start(self, start: ArrayLike) -> Array:
        joints = len(self.robot.chain)
        try:
            q = np.ascontiguousarray(start, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise StartError(f"is no row of numbers ({error}).", field="start") from error
        if q.shape != (joints,):
            raise StartError(f"is {q.shape}.", field="start", hint=f"{self.robot.name} has {joints} joints")
        if not np.isfinite(q).all():
            raise StartError("has values that are not finite.", field="start", hint="give radians and metres")
        return q

    def _check_start(self, q: Array, begin: float) -> PlanResult | None:
        cause = limit_violation(self.robot.chain, q)
        if cause is not None:
            return self._failure(PlanStatus.START_STATE_INVALID, cause, f"{cause}.", begin)
        if self.arm.check(self.field, q[None]).in_collision[0]:
            cause = collision(self.arm, self.field, q)
            return self._failure(PlanStatus.START_STATE_IN_COLLISION, cause, f"{cause}.", begin)
        return None

    def _prepare(self, ends: Array) -> None:
        """Choose an eps with which edges can leave and reach configurations (K, J) of small clearance."""
        clearance = float(self.arm.native.clearance(self.field.native, ends, 4 * self.eps)[0].min())
        eps = max(CONSTANTS.min_eps, min(self.eps, clearance / 4))
        if eps != self._eps:
            self._eps, self._native = eps, self._planner(eps)

    def _search(self, run: Callable[[ArmPlanner], int]) -> int:
        """Run the native planner, which a cancel during the preparation ends at once; return how it ended."""
        if self._cancelled.is_set():
            self._native.cancel()
        end = run(self._native)
        self._cancelled.clear()
        return end

    def _result(self, end: int, start: Array, goals: Array, before: float, begin: float, until: float) -> PlanResult:
        status = _STATUS[end]
        if status is not None:
            cause = blocked_line(self.arm, self.field, start, goals[0], self._eps)
            preempted = status is PlanStatus.PREEMPTED
            reason = "cancelled" if preempted else f"no path was found; on the straight line {cause}"
            return self._failure(status, cause, f"{reason}.", begin)
        waypoints, cost, history = self._native.best()
        if len(waypoints) == 1:
            waypoints = np.repeat(waypoints, 2, axis=0)
        history[:, 0] += before
        path = Path(waypoints, float(cost), self.certificate(waypoints, until))
        if not path.certificate.certified:
            return self._failure(PlanStatus.PLANNING_FAILED, None, "the path found is not certified.", begin)
        return self._timed_result(PlanStatus.SUCCESS, path, history, None, "", begin)

    def _failure(self, status: PlanStatus, cause: Cause | None, reason: str, begin: float) -> PlanResult:
        return self._timed_result(status, None, np.zeros((0, 2)), cause, reason, begin)

    def _timed_result(
        self,
        status: PlanStatus,
        path: Path | None,
        history: NDArray[np.float64],
        cause: Cause | None,
        reason: str,
        begin: float,
    ) -> PlanResult:
        searched = status in _STATUS or path is not None
        return PlanResult(
            status,
            path,
            history,
            cause,
            reason,
            time.perf_counter() - begin,
            int(self._native.iterations) if searched else 0,
            int(self._native.edges) if searched else 0,
            int(self._native.nodes) if searched else 0,
            self.field.map_version,
        )


def _for_search(budget_ms: float, spent: float) -> float:
    """Return the part of the budget that is left for the search [s]."""
    budget = 1e-3 * budget_ms
    return max(1e-4, budget - spent - min(CONSTANTS.certificate_reserve, budget / 3))


def _check_budget(budget_ms: float, iterations: int | None) -> None:
    if not 0.0 < budget_ms < np.inf:
        raise InputError(f"is {budget_ms}.", field="budget_ms", hint="give milliseconds above 0")
    if iterations is not None and not 0 < iterations < 2**62:
        raise InputError(f"is {iterations}.", field="iterations", hint="give a number above 0")
