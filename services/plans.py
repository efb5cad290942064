"""The latest plans, so that a motion request can name a plan by its id."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from uuid import uuid4

from splatbot.errors import InputError
from splatbot.planning import JointTrajectory, PlanResult

_KEPT = 256


class PlanNotFoundError(InputError):
    """No plan of that id, or it is too old."""

    http_status = 404


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned motion.

    Args:
        id: in URLs.
        map_id: of the map that it was planned in.
        robot: name of the model.
        result: of the search; it has a path.
        trajectory: the path with its time.
    """

    id: str
    map_id: str
    robot: str
    result: PlanResult
    trajectory: JointTrajectory


class Plans:
    """The latest 256 plans by id."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._plans: OrderedDict[str, Plan] = OrderedDict()

    def add(self, map_id: str, robot: str, result: PlanResult, trajectory: JointTrajectory) -> Plan:
        """Keep a plan."""
        plan = Plan(uuid4().hex[:16], map_id, robot, result, trajectory)
        with self._lock:
            self._plans[plan.id] = plan
            if len(self._plans) > _KEPT:
                self._plans.popitem(last=False)
        return plan

    def get(self, plan_id: str) -> Plan:
        """Return a plan.

        Raises:
            PlanNotFoundError: the id is unknown.
        """
        with self._lock:
            if plan_id not in self._plans:
                raise PlanNotFoundError(f"No plan {plan_id[:40]!r}.", field="plan", hint="plan again")
            return self._plans[plan_id]
