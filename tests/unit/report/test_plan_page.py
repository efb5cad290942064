"""Tests of splatbot.report.plan_page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from splatbot.collision import RobotSpheres
from splatbot.planning import Certificate, JointTrajectory
from splatbot.planning.closest import ClosestApproach
from splatbot.report import plan_page
from splatbot.report.annotations import legend_size
from splatbot.robots.appearance import coarse_appearance
from splatbot.robots.store import load_robot
from tests.unit.grasping.objects import model


def test_the_legend_of_a_plan_names_all_that_is_drawn_and_fits_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot("ur5e-2f85")
    q = np.asarray(robot.home) + np.linspace(0.0, 0.5, 14)[:, None] * np.eye(6)[0]
    plan = JointTrajectory(robot.chain.names, q, 0.1, Certificate(True, 1e-3, 0.0, 0.0, 1))
    arm, drawn = RobotSpheres(robot, T_world_base=np.eye(4)), model()
    rows: list[tuple[str, Any]] = []

    def kept(image: Any, legend: Sequence[tuple[str, Any]]) -> Any:
        rows.extend(legend)
        return image

    monkeypatch.setattr(plan_page, "with_legend", kept)
    at = np.array([0.5, 0.0, 0.3])
    nearest = ClosestApproach(0.4, 6, "wrist_3_joint", 0.012, "the map", at, at)
    parts = coarse_appearance(robot)
    plan_page.plan_png(drawn, arm, plan, parts, robot.fk, robot.T_link_tcp, nearest=nearest, width=960)
    names = [name for name, _ in rows]
    assert names[:3] == ["arm at the start", "arm at the goal; transparent: in between", "path of the tool"]
    assert names[3].startswith("ring: nearest to the map, 12.0 mm beyond the margin")
    assert len({color for _, color in rows}) == 4
    assert legend_size(rows)[0] < 960
