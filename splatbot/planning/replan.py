"""A path that is kept good while the map changes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from numpy.typing import ArrayLike

from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.planning.problem import Certificate, Goal, Path, PlanResult
from splatbot.planning.rrt_star import GaussianRRTStar


@dataclass(frozen=True, eq=False)
class Update:
    """What a later map means for a path.

    Args:
        result: with the path, the old one or a repaired one, certified on the later map.
        kept: whether the path stands as it was.
        clearance_before: [m] that it had on the map before; compare with the certificate's to slow down.
        seconds: that it took to find out and, if need be, to repair.
    """

    result: PlanResult
    kept: bool
    clearance_before: float
    seconds: float


class Replanner:
    """Plans once and then follows the map: a path is asked of what is new alone, and what breaks is repaired.

    The planner's tree outlives the change: of its edges too, only what is new in the map is asked, and the
    configurations behind those cut off are joined again where that can be.

    Args:
        planner: whose ``field`` moves on with :meth:`update`.
    """

    def __init__(self, planner: GaussianRRTStar) -> None:
        self.planner = planner
        self._result: PlanResult | None = None
        self._of_tree = planner.field  # the map that the tree was last compared with

    @property
    def path(self) -> Path | None:
        """The path in force."""
        return None if self._result is None else self._result.path

    def plan(self, start: ArrayLike, goal: Goal | ArrayLike, *, budget_ms: float = 28.0, seed: int = 0) -> PlanResult:
        """As :meth:`splatbot.planning.GaussianRRTStar.plan`, whose path is then in force."""
        self._result = self.planner.plan(start, goal, budget_ms=budget_ms, seed=seed)
        self._of_tree = self.planner.field
        return self._result

    def update(
        self, field: GaussianCollisionField, *, start: ArrayLike | None = None, budget_ms: float = 10.0, seed: int = 0
    ) -> Update:
        """Compares the path in force with a later field, and repairs it if it no longer stands.

        Args:
            field: of the later map, best made by ``updated`` from the field before: what both share costs nothing.
            start: (J,) where the arm is now, on the path; only a repair begins there. None: where the path begins.
            budget_ms: for a repair, certificate included.
            seed: of its samples.

        Raises:
            InputError: there is no path, or the fields differ in n_sigma.
            StartError: the start is of another shape or not finite.
        """
        begin = time.perf_counter()
        if self._result is None or self._result.path is None:
            raise InputError("has no path yet.", field="plan", hint="call plan first")
        path = self._result.path
        certificate = self._standing(field, path)
        if certificate is not None:
            self.planner.field = field
            self._result = replace(
                self._result, path=replace(path, certificate=certificate), map_version=field.map_version
            )
        else:
            self._repair(field, path.waypoints[0] if start is None else start, budget_ms, seed, begin)
        seconds = time.perf_counter() - begin
        return Update(self._result, certificate is not None, path.certificate.clearance, seconds)

    def _standing(self, field: GaussianCollisionField, path: Path) -> Certificate | None:
        """The path's certificate on the later field; None: something new is in its way."""
        was = path.certificate
        added = field.added_since(self.planner.field)
        if not len(added):
            return replace(was, map_version=field.map_version)
        room = self.planner.room_to(added, path.waypoints, was.clearance, was.eps)
        return None if room is None else replace(was, map_version=field.map_version, clearance=min(room, was.clearance))

    def _repair(
        self, field: GaussianCollisionField, start: ArrayLike, budget_ms: float, seed: int, begin: float
    ) -> None:
        left = budget_ms - 1e3 * (time.perf_counter() - begin)
        result = self.planner.plan_again(field, self._of_tree, start, budget_ms=max(0.1, left), seed=seed)
        self._of_tree = field
        self._result = result
