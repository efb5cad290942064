"""Searches end with the service, and no later one begins."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField
from splatbot.geometry import pose_from_quat
from splatbot.planning import GaussianRRTStar, PlanResult, PlanStatus
from splatbot.robots.panda import panda
from splatbot.services.problems import BusyError
from splatbot.services.searches import Searches
from tests.contracts.conftest import wall


def test_a_stop_ends_a_search_with_its_best_path_and_refuses_later_ones() -> None:
    base = pose_from_quat((-0.8, -0.4, 1.0), (0.70710678, -0.70710678, 0.0, 0.0))
    planner = GaussianRRTStar(GaussianCollisionField(wall().model), panda(), T_world_base=base)
    start, goal = (np.array([turn, 0.3, 0.0, -1.5, 0.0, 1.9, 0.8]) for turn in (1.0, -1.0))
    searches = Searches()

    def search() -> PlanResult:
        with searches.running(planner):
            return planner.plan(start, goal, budget_ms=60_000.0)

    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(search)
        while not len(planner.best()[0]):
            assert not running.done()
            time.sleep(0.01)
        searches.stop()
        assert running.result(30).status is PlanStatus.SUCCESS
    with pytest.raises(BusyError, match="is stopping"):
        search()
