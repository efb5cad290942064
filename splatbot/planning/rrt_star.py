"""The planner: RRT-Connect for a first path, shortcuts, then RRT* until time is up; every edge is certified."""

from __future__ import annotations

import threading
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot._native import ArmPlanner, path_clearance
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.robot import EPS
from splatbot.errors import InputError
from splatbot.planning.causes import beyond_limits, blocked_line, collision
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

CLEARANCE_CUT = 0.1  # [m]; more room than this is not told apart
POSTURES_SHARE = 0.25  # of the budget for postures that reach a pose, once there is one
_CLEARANCE_ROUNDS = 6  # of halving: clearance to 2 %
_RESERVE = 7e-4  # [s] of the budget kept for the certificate, at most a third of it
_FINEST = 4e-5  # [m] that eps is lowered to where the start or a goal has hardly any room
_ENDS = (None, PlanStatus.PLANNING_FAILED, PlanStatus.TIMED_OUT, PlanStatus.PREEMPTED)


class GaussianRRTStar:
    """Plans an arm's way among the Gaussians of one state of a map.

    Every edge of its trees is certified all along, against the map and against the arm itself
    (:meth:`splatbot.collision.RobotSpheres.certify`), so that a path is certified when it is found. The first path is
    that of RRT-Connect; both of its trees then become one, which RRT* (Karaman and Frazzoli, IJRR 2011) rewires with
    samples from the ellipsoid of what can be better (Gammell et al., IROS 2014), helped by shortcuts of the best path
    and by RRT-Connect run anew with the best cost as its bound. Costs are lengths in joint space [rad].

    One search at a time: calls from several threads wait for one another, outside of their budgets.

    Args:
        field: the map.
        robot: the arm.
        T_world_base: (4, 4) pose of its base.
        opening: of the gripper [m]; None: as wide as it goes.
        attached: (A, 4) spheres (x, y, z, radius) [m] of a held object in the frame of the last link.
        margin: room that the arm keeps to the map [m]; it may come nearer to itself.
        base_in_map: see :class:`splatbot.collision.RobotSpheres`.
        eps: room [m] below which an edge is not certified.

    Raises:
        InputError: as :class:`splatbot.collision.RobotSpheres`; eps is not above 4e-5 m.
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
        if not _FINEST <= eps < np.inf:
            raise InputError(f"is {eps}.", field="eps", hint=f"give metres, at least {_FINEST:g}")
        self._field, self.robot, self.margin, self.eps = field, robot, margin, eps
        self.arm = RobotSpheres(
            robot,
            T_world_base=T_world_base,
            opening=opening,
            attached=attached,
            base_in_map=base_in_map,
            margin=margin,
        )
        self._eps = eps  # of the problem at hand
        self._native = self._planner(eps)
        self._goals: Array | None = None  # of the last search
        self._searching = threading.Lock()

    @property
    def field(self) -> GaussianCollisionField:
        """The map. One that is assigned holds for the searches that follow."""
        return self._field

    @field.setter
    def field(self, field: GaussianCollisionField) -> None:
        with self._searching:
            self._look_at(field)

    def _look_at(self, field: GaussianCollisionField) -> None:
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
        """The best path from ``start`` (J,) to ``goal`` that is found in time.

        Args:
            start: (J,) [rad or m].
            goal: see :mod:`splatbot.planning.problem`; an array (J,) or (K, J) is a set of configurations.
            budget_ms: that the whole call may take, inverse kinematics and certificate included.
            seed: of the samples.
            iterations: of the trees' growth; where they, not the time, end the search, equal calls give equal paths.

        Returns:
            A path with its certificate, or the reason why there is none. The time being up is no failure once there is
            a path.

        Raises:
            StartError: the start is of another shape or not finite.
            GoalError: the goal is, or makes no sense for this robot.
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
        failed = self._bad_start(q, begin)
        if failed is not None:
            return failed
        goals = goal_configurations(
            self.arm, self.field, goal, near=q, seed=seed, until=begin + POSTURES_SHARE * 1e-3 * budget_ms
        )
        if not len(goals.q):
            return self._failure(goals.status, goals.cause, goals.reason, begin)
        self._prepare(np.concatenate([q[None], goals.q]))
        self._goals = goals.q
        before = time.perf_counter() - begin
        left = _for_search(budget_ms, before)
        end = self._native.run(q, goals.q, left, 2**62 if iterations is None else iterations, seed, 0.0)
        return self._result(end, q, goals.q, before, begin, begin + 1e-3 * budget_ms)

    def solve(
        self, problem: PlanningProblem, *, budget_ms: float = 28.0, seed: int = 0, iterations: int | None = None
    ) -> PlanResult:
        """As :meth:`plan`, of a problem."""
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
        """Plans to the goals of the last :meth:`plan` with its old tree on a later field, which is this planner's then.

        Args:
            field: of the later map.
            before: the field that the tree stands on: only what ``field`` has beyond it is asked of the tree's edges.
            start: (J,) on the last path, or anywhere: then the tree begins anew.
            budget_ms: that the call may take.
            seed: of the samples.

        Raises:
            StartError: the start is of another shape or not finite.
            InputError: nothing was planned before, the fields differ in n_sigma, or budget_ms is not above 0.
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
        self._look_at(field)
        q = self._start(start)
        failed = self._bad_start(q, begin)
        if failed is not None:
            return failed
        goals = goal_configurations(self.arm, field, self._goals, near=q, seed=seed, until=begin)
        if not len(goals.q):
            return self._failure(goals.status, goals.cause, goals.reason, begin)
        added = field.added_since(before)
        spent = time.perf_counter() - begin
        left = _for_search(budget_ms, spent)
        end = self._native.rerun(q, field.native, added.native, self.arm.without_pairs.native, left, 2**62, seed)
        return self._result(end, q, goals.q, spent, begin, begin + 1e-3 * budget_ms)

    def room_to(self, field: GaussianCollisionField, waypoints: Array, cut: float, eps: float) -> float | None:
        """Room [m] along a path (N, J) to a field alone, the arm itself left out, up to ``cut``; None: not free."""
        arm = self.arm.without_pairs
        if arm.certify(field, waypoints[:-1], waypoints[1:], eps=eps).in_collision.any():
            return None
        return float(path_clearance(arm.native, field.native, waypoints, max(cut, eps), _CLEARANCE_ROUNDS, np.inf))

    def cancel(self) -> None:
        """Ends the search of another thread's :meth:`plan`, which returns the best path so far, or PREEMPTED."""
        self._native.cancel()

    def best(self) -> tuple[Array, float, NDArray[np.float64]]:
        """Waypoints (N, J), cost and history (H, 2) of the search that another thread runs; N is 0 before the first."""
        waypoints, cost, history = self._native.best()
        return waypoints, float(cost), history

    def tree(self) -> tuple[Array, NDArray[np.int32], Array]:
        """Nodes (N, J), their parents (N,), -1 for the root, and costs from it (N,), of the last search."""
        with self._searching:
            q, parent, cost = self._native.tree()
        return q, parent, cost

    @property
    def nbytes(self) -> int:
        """Bytes of the tree of the last search."""
        with self._searching:
            return int(self._native.bytes)

    def certificate(self, waypoints: Array, until: float = np.inf) -> Certificate:
        """What can be promised of a path (N, J): whether all its edges are free, and the room along it.

        The room is a lower bound, within a few percent unless ``until`` (of ``time.perf_counter``) comes before.
        """
        # The trees' edges were checked in the direction they grew; rounding may make a difference to the other one.
        for eps in (self._eps, self._eps / 4):
            if not self.arm.certify(self.field, waypoints[:-1], waypoints[1:], eps=eps).in_collision.any():
                left = until - time.perf_counter()
                room = path_clearance(
                    self.arm.native, self.field.native, waypoints, CLEARANCE_CUT, _CLEARANCE_ROUNDS, left
                )
                return Certificate(True, eps, room, self.margin, self.field.map_version)
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

    def _bad_start(self, q: Array, begin: float) -> PlanResult | None:
        cause = beyond_limits(self.robot.chain, q)
        if cause is not None:
            return self._failure(PlanStatus.START_STATE_INVALID, cause, f"{cause}.", begin)
        if self.arm.check(self.field, q[None]).in_collision[0]:
            cause = collision(self.arm, self.field, q)
            return self._failure(PlanStatus.START_STATE_IN_COLLISION, cause, f"{cause}.", begin)
        return None

    def _prepare(self, ends: Array) -> None:
        """A planner whose eps lets it leave and reach configurations (K, J) that nearly touch something."""
        room = float(self.arm.native.clearance(self.field.native, ends, 4 * self.eps)[0].min())
        eps = max(_FINEST, min(self.eps, room / 4))
        if eps != self._eps:
            self._eps, self._native = eps, self._planner(eps)

    def _result(self, end: int, start: Array, goals: Array, before: float, begin: float, until: float) -> PlanResult:
        status = _ENDS[end]
        if status is not None:
            cause = blocked_line(self.arm, self.field, start, goals[0], self._eps)
            why = "cancelled" if status is PlanStatus.PREEMPTED else f"no path was found; on the straight line {cause}"
            return self._failure(status, cause, f"{why}.", begin)
        waypoints, cost, history = self._native.best()
        if len(waypoints) == 1:
            waypoints = np.repeat(waypoints, 2, axis=0)
        history[:, 0] += before
        path = Path(waypoints, float(cost), self.certificate(waypoints, until))
        if not path.certificate.certified:
            return self._failure(PlanStatus.PLANNING_FAILED, None, "the path found is not certified.", begin)
        return self._answer(PlanStatus.SUCCESS, path, history, None, "", begin)

    def _failure(self, status: PlanStatus, cause: Cause | None, reason: str, begin: float) -> PlanResult:
        return self._answer(status, None, np.zeros((0, 2)), cause, reason, begin)

    def _answer(
        self,
        status: PlanStatus,
        path: Path | None,
        history: NDArray[np.float64],
        cause: Cause | None,
        reason: str,
        begin: float,
    ) -> PlanResult:
        searched = status in _ENDS or path is not None
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
    """Seconds of the budget that are left for the search."""
    budget = 1e-3 * budget_ms
    return max(1e-4, budget - spent - min(_RESERVE, budget / 3))


def _check_budget(budget_ms: float, iterations: int | None) -> None:
    if not 0.0 < budget_ms < np.inf:
        raise InputError(f"is {budget_ms}.", field="budget_ms", hint="give milliseconds above 0")
    if iterations is not None and not 0 < iterations < 2**62:
        raise InputError(f"is {iterations}.", field="iterations", hint="give a number above 0")
