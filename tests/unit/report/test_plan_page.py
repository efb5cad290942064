"""Tests of splatbot.report.plan_page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pytest

from splatbot.collision import RobotSpheres
from splatbot.errors import InputError
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.planning import Certificate, JointTrajectory
from splatbot.planning.closest import ClosestApproach
from splatbot.report import plan_page
from splatbot.report.annotations import legend_size, over_legend
from splatbot.report.sphere_gaussians import sphere_gaussians
from splatbot.robots.appearance import coarse_appearance
from splatbot.robots.store import load_robot
from tests.unit.grasping.objects import model


def test_the_legend_of_a_plan_names_all_that_is_drawn_and_fits_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot("ur5e-2f85")
    q = np.asarray(robot.home) + np.linspace(0.0, 0.5, 14)[:, None] * np.eye(6)[0]
    plan = JointTrajectory(robot.chain.names, q, 0.1, Certificate(True, 1e-3, 0.0, 0.0, 1))
    arm, drawn = RobotSpheres(robot, T_world_base=np.eye(4), margin=0.02), model()
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
    assert names[:3] == ["arm at the start", "arm at the goal", "path of the tool"]
    assert names[3].startswith("ring: nearest to the map, 12.0 mm beyond the margin")
    assert names[4] == "shell: certified spheres of the nearest link, and 20.0 mm of margin"
    assert len({color for _, color in rows}) == 5
    assert legend_size(rows)[0] < 960


@pytest.mark.parametrize(("height", "seen"), [(0.2, True), (-0.03, False)], ids=["in the open", "in the table"])
def test_the_legend_of_a_refusal_hides_nothing_and_names_obstacles_only_where_they_are_seen(
    monkeypatch: pytest.MonkeyPatch, height: float, seen: bool
) -> None:
    """The table is opaque, and the camera looks from above."""
    robot = load_robot("ur5e-2f85")
    legend: list[tuple[str, Any]] = []
    views: list[np.ndarray] = []

    def kept(image: Any, rows: Sequence[tuple[str, Any]]) -> Any:
        legend.extend(rows)
        views.append(image)
        return over_legend(image, rows)

    monkeypatch.setattr(plan_page, "over_legend", kept)
    solids = sphere_gaussians(np.array([[0.5, 0.0, height]]), np.array([0.005]), np.array([0.5, 0.5, 0.5]), 0.99)
    picture = plan_page.refused_png(
        model(), RobotSpheres(robot), np.asarray(robot.home), coarse_appearance(robot), robot.fk,
        point=np.array([0.5, 0.0, 0.1]), reason="x", solids=solids, width=320,
    )  # fmt: skip
    assert any(name.startswith("obstacles") for name, _ in legend) == seen
    drawn = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert drawn is not None
    drawn = drawn[..., ::-1].astype(np.float64)
    assert drawn.shape == (240 + legend_size(legend)[1], 320, 3)
    assert np.abs(drawn[:240] - 255.0 * np.clip(views[0], 0.0, 1.0)).max() <= 1.0


@pytest.mark.parametrize("place", [(1.5, -0.4, 1.0), (-0.6, 0.9, 1.4), (0.2, 0.0, 3.0)])
def test_a_camera_at_a_given_place_shows_the_arm_and_the_surroundings_of_the_path(
    place: tuple[float, float, float],
) -> None:
    robot = load_robot("ur5e-2f85")
    T_world_base = look_at(np.array([0.3, -0.2, 0.5]), np.zeros(3))
    arm = RobotSpheres(robot, T_world_base=T_world_base)
    q = np.asarray(robot.home) + np.linspace(0.0, 0.5, 14)[:, None] * np.eye(6)[0]
    tool = (T_world_base @ robot.fk(q)[:, -1] @ robot.T_link_tcp)[:, :3, 3]
    camera, T_world_camera, away = plan_page.framed_from(np.array(place), arm, q, tool, 640)
    assert transform_points(inverse(T_world_base), T_world_camera[:3, 3]) == pytest.approx(place)
    near = tool[:, None] + 0.15 * np.array([[0, 0, 0], [1, 1, 1], [-1, 1, -1], [1, -1, -1]])
    points = np.concatenate([arm.centers(q).reshape(-1, 3), near.reshape(-1, 3)])
    x, y, z = transform_points(inverse(T_world_camera), points).T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    assert (z > 0).all()
    assert u.min() > 0
    assert u.max() < 639
    assert v.min() > 0
    assert v.max() < 479
    assert max(np.ptp(u) / 640, np.ptp(v) / 480) > 0.85
    assert away == pytest.approx(np.median(z), rel=0.5)


def test_a_camera_within_the_motion_is_refused() -> None:
    robot = load_robot("ur5e-2f85")
    q = np.asarray(robot.home)[None]
    arm = RobotSpheres(robot)
    with pytest.raises(InputError, match="within the motion"):
        plan_page.framed_from(arm.centers(q)[0].mean(axis=0), arm, q, arm.centers(q)[0, -1:], 640)
