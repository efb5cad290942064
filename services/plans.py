"""The latest plans, so that a motion request can name a plan by its id."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.planning import JointTrajectory, PlanResult
from splatbot.services.motion_gate import MotionRequest
from splatbot.services.store import ServedMap

_KEPT = 256


class PlanNotFoundError(InputError):
    """No plan of that id, or it is too old."""

    http_status = 404


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned motion.

    Args:
        id: in URLs.
        map_id, generation: of the map that it was planned in.
        robot: name of the model.
        T_world_base: (4, 4) base of the robot [m].
        result: of the search; it has a path.
        trajectory: the path with its time.
        margin_source: where its margin comes from.
        covers: scope of the certificate, see :meth:`splatbot.results.region_plan.RegionPlan.scope`.
    """

    id: str
    map_id: str
    generation: int
    robot: str
    T_world_base: NDArray[np.float64]
    result: PlanResult
    trajectory: JointTrajectory
    margin_source: str
    covers: dict[str, Any]

    @property
    def motion(self) -> MotionRequest:
        """The plan as a motion for an arm."""
        margin = self.trajectory.certificate.margin
        return MotionRequest(self.trajectory, self.robot, self.map_id, self.generation, self.T_world_base, margin)


class Plans:
    """The latest 256 plans by id."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._plans: OrderedDict[str, Plan] = OrderedDict()

    def add(
        self,
        served: ServedMap,
        robot: str,
        T_world_base: NDArray[np.float64],
        result: PlanResult,
        trajectory: JointTrajectory,
        margin_source: str,
        covers: dict[str, Any],
    ) -> Plan:
        """Keep a plan."""
        plan = Plan(
            uuid4().hex[:16],
            served.id,
            served.generation,
            robot,
            T_world_base,
            result,
            trajectory,
            margin_source,
            covers,
        )
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
