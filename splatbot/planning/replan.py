"""Replanning: a path stays certified while the map changes."""

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
    """Effect of a later map on the current path.

    Args:
        result: plan on the later map, with the unchanged path or a repaired one.
        kept: True if the path is unchanged.
        clearance_before: clearance of the path on the previous map [m]; a smaller one in the certificate is a reason
            to slow down.
        seconds: duration of the check and the repair [s].
    """

    result: PlanResult
    kept: bool
    clearance_before: float
    seconds: float


class Replanner:
    """Replanner that checks the current path against new Gaussians and repairs it if one blocks it.

    The planner keeps its search tree. Its edges, too, are checked against the new Gaussians only. Nodes that a blocked
    edge disconnects are reconnected where possible.

    Args:
        planner: planner whose ``field`` becomes the field of each :meth:`update`.
    """

    def __init__(self, planner: GaussianRRTStar) -> None:
        self.planner = planner
        self._result: PlanResult | None = None
        self._tree_field = planner.field  # map against which the tree was last checked

    @property
    def path(self) -> Path | None:
        """Current path, or None."""
        return None if self._result is None else self._result.path

    def plan(self, start: ArrayLike, goal: Goal | ArrayLike, *, budget_ms: float = 28.0, seed: int = 0) -> PlanResult:
        """Plan as :meth:`splatbot.planning.GaussianRRTStar.plan` does and make the result the current path."""
        self._result = self.planner.plan(start, goal, budget_ms=budget_ms, seed=seed)
        self._tree_field = self.planner.field
        return self._result

    def update(
        self, field: GaussianCollisionField, *, start: ArrayLike | None = None, budget_ms: float = 10.0, seed: int = 0
    ) -> Update:
        """Check the current path against a later field and repair it if it collides.

        Args:
            field: field of the later map; ``updated`` of the previous field makes it share unchanged Gaussians.
            start: (J,) current configuration on the path, where a repair begins [rad or m]. If None, a repair begins
                at the start of the path.
            budget_ms: time for a repair, certificate included [ms].
            seed: seed of the samples.

        Raises:
            InputError: there is no path, or the fields differ in n_sigma.
            StartError: the start has a wrong shape or is not finite.
        """
        begin = time.perf_counter()
        if self._result is None or self._result.path is None:
            raise InputError("has no path yet.", field="plan", hint="call plan first")
        path = self._result.path
        certificate = self._recertified(field, path)
        if certificate is not None:
            self.planner.field = field
            self._result = replace(
                self._result, path=replace(path, certificate=certificate), map_version=field.map_version
            )
        else:
            self._repair(field, path.waypoints[0] if start is None else start, budget_ms, seed, begin)
        seconds = time.perf_counter() - begin
        return Update(self._result, certificate is not None, path.certificate.clearance, seconds)

    def _recertified(self, field: GaussianCollisionField, path: Path) -> Certificate | None:
        """Return the certificate of the path on the later field, or None if a new Gaussian blocks it."""
        old = path.certificate
        added = field.added_since(self.planner.field)
        if not len(added):
            return replace(old, map_version=field.map_version)
        clearance = self.planner.clearance_to(added, path.waypoints, old.clearance, old.eps)
        if clearance is None:
            return None
        return replace(old, map_version=field.map_version, clearance=min(clearance, old.clearance))

    def _repair(
        self, field: GaussianCollisionField, start: ArrayLike, budget_ms: float, seed: int, begin: float
    ) -> None:
        left = budget_ms - 1e3 * (time.perf_counter() - begin)
        result = self.planner.plan_again(field, self._tree_field, start, budget_ms=max(0.1, left), seed=seed)
        self._tree_field = field
        self._result = result
