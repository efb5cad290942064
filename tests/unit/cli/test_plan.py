"""`splatbot plan`."""

from __future__ import annotations

import base64
import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.cli.plan import _margin_text
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.robots.panda import panda
from splatbot.workspace import Workspace
from tests.unit.cli.conftest import RunCommand, assert_refused
from tests.unit.grasping.files import STANDING, grasp_file_values, grasp_values

BASE = ("--base", 0, 0, 0, 1, 0, 0, 0)
UPRIGHT = (0.0, 0.0, 0.0, -0.5, 0.0, 0.5, 0.8)
GOAL = (0.9, -0.3, 0.1, -2.0, 0.2, 1.8, 0.5)


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.ply"
    tabletop().gaussians(4000).save(path)
    return path


@pytest.mark.long
def test_the_pregrasp_of_a_grasp_is_a_goal(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    file = tmp_path / "grasp.json"
    file.write_text(json.dumps(grasp_file_values(grasp_values(UPRIGHT), grasp_values(GOAL))))
    out = tmp_path / "out"
    words = ("plan", "--map", map_file, *BASE, "--start", "home", "--grasp", file, "--grasp-index", 1)
    answer = run(*words, "--out", out)
    assert answer.code == 0, answer.err
    last = json.loads((out / "trajectory.json").read_text())["points"][-1]["positions"]
    np.testing.assert_allclose(last, GOAL, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "index", "why"),
    [
        ({"grasps": None}, 0, "is no file of grasps"),
        ({"grasps": [{}]}, 0, "is no file of grasps"),
        ({"T_world_base": {"translation": [0, 0]}}, 0, "is no file of grasps"),
        ({"grasps": []}, 0, "grasps: holds no grasp of red box: the search found none"),
        ({"grasps": [grasp_values((0.0,))]}, 0, "has no joint values"),
        ({"grasps": [grasp_values(None)]}, 0, "has no joint values"),
        ({"grasps": [grasp_values((0, 0, 0, float("nan"), 0, 0, 0))]}, 0, "has no joint values"),
        ({"grasps": [grasp_values(GOAL) | {"contacts": [[0, 0, 0]]}]}, 0, "is no file of grasps"),
        ({"grasps": [grasp_values(GOAL) | {"approach_path": [[0, 0]]}]}, 0, "is no file of grasps"),
        ({"unknown_space": "maybe"}, 0, "is no file of grasps"),
        ({}, -1, "--grasp-index: is -1"),
        ({"robot": "ur5e-2f85"}, 0, "give --robot ur5e-2f85"),
        ({"T_world_base": STANDING | {"translation": [0, 0, 0.01]}}, 0, "give the --base of the grasps"),
    ],
)
def test_files_of_grasps_that_give_no_goal_are_refused(
    run: RunCommand, map_file: Path, tmp_path: Path, changes: dict[str, Any], index: int, why: str
) -> None:
    file = tmp_path / "grasp.json"
    file.write_text(json.dumps(grasp_file_values(grasp_values(GOAL)) | changes))
    words = ("plan", "--map", map_file, *BASE, "--start", "home", "--out", tmp_path / "out")
    assert_refused(run(*words, "--grasp", file, "--grasp-index", index), why)
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_no_json_and_two_goals_are_refused(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    file = tmp_path / "grasp.json"
    file.write_text("{")
    words = ("plan", "--map", map_file, *BASE, "--start", "home")
    assert_refused(run(*words, "--grasp", file), "is no file of grasps")
    assert_refused(run(*words, "--grasp", file, "--goal", "home"), "must be given, one of them")
    assert_refused(run(*words), "must be given, one of them")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--goal-pose", 450, 0, 250, 0, 1, 0, 0), "give metres: 0.45 0 0.25"),
        (("--goal", *GOAL, "--margin", 5), "give metres, at most 1: 0.005"),
    ],
)
def test_millimetres_are_suspected_before_the_map_is_read(
    run: RunCommand, map_file: Path, words: tuple[Any, ...], why: str
) -> None:
    map_file.write_bytes(b"no map")
    assert_refused(run("plan", "--map", map_file, *BASE, "--start", "home", *words), why)


@pytest.mark.parametrize("proposed", [True, False])
def test_a_start_in_collision_names_the_correction_of_a_base_that_is_only_proposed(
    run: RunCommand, map_file: Path, tmp_path: Path, proposed: bool
) -> None:
    base = np.eye(4)
    base[2, 3] = -0.4  # below the table
    Workspace(T_world_base=base, base_proposed=proposed).save(tmp_path / "scene.yaml")
    answer = run("plan", "--map", map_file, "--start", "home", "--goal", *GOAL, "--out", tmp_path / "out")
    assert_refused(answer, "mm deep in")
    assert (f"correct the base, which is only proposed: splatbot info {map_file}" in answer.err) == proposed


@pytest.mark.parametrize(
    "goal",
    [("--goal", 0.0, 0.9, 0.0, -1.9, 0.0, 2.8, 0.8), ("--goal-pose", 0.5, 0.0, -0.05, 0, 1, 0, 0)],
    ids=["joints", "pose"],
)
def test_a_goal_in_the_table_is_refused_with_a_picture_of_the_arm_there(
    run: RunCommand, map_file: Path, tmp_path: Path, goal: tuple[Any, ...]
) -> None:
    out = tmp_path / "out"
    answer = run("plan", "--map", map_file, *BASE, "--start", "home", *goal, "--out", out)
    assert_refused(answer, "mm deep")
    assert str(out / "refused.png") in answer.err
    picture = cv2.imread(str(out / "refused.png"))
    assert picture is not None
    red = (picture[..., 2] > 200) & (picture[..., 1] < 90) & (picture[..., 0] < 100)
    assert red.sum() > 200  # the ring
    assert sorted(path.name for path in out.iterdir()) == ["refused.png"]


def test_a_certified_trajectory_is_written_with_its_pictures(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    answer = run("plan", "--map", map_file, *BASE, "--start", "home", "--goal", *GOAL, "--out", out)
    assert answer.code == 0, answer.err
    assert "certified" in answer.out
    summary = json.loads((out / "plan.json").read_text())
    assert summary["status"] == "SUCCESS"
    assert summary["certified"]
    assert summary["robot"] == "panda"
    assert summary["joint_names"] == [f"panda_joint{k}" for k in range(1, 8)]
    assert summary["T_world_base"] == {"translation": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}
    assert (summary["covers"]["base_in_map"], summary["covers"]["hand"]) == (False, True)
    assert not summary["covers"]["base_proposed"]
    message = json.loads((out / "trajectory.json").read_text())
    np.testing.assert_allclose(message["points"][0]["positions"], panda().home, atol=1e-9)
    np.testing.assert_allclose(message["points"][-1]["positions"], GOAL, atol=1e-9)
    rows = list(csv.reader((out / "trajectory.csv").open()))
    q = np.array([[float(x) for x in row[1:8]] for row in rows[1:]])
    field = GaussianCollisionField(tabletop().gaussians(4000))
    assert not RobotSpheres(panda()).check(field, q).in_collision.any()
    picture = cv2.imread(str(out / "plan.png"))
    assert picture is not None
    assert picture.shape == (960, 1280, 3)
    assert picture.std() > 5
    page = (out / "plan.html").read_text()
    assert "http://" not in page
    assert "https://" not in page
    assert page.count("<script") == 3
    data = json.loads(page.split('id="data">')[1].split("</script>")[0])
    link = np.frombuffer(base64.b64decode(data["link"]), np.uint16)
    assert set(link) == set(range(8))
    assert len(link) < 6000
    poses = np.frombuffer(base64.b64decode(data["poses"]), np.float32).reshape(-1, 8, 3, 4)
    np.testing.assert_allclose(poses[-1], panda().fk(np.array(GOAL))[:, :3], atol=1e-5)


def test_a_base_that_stands_in_the_map_is_reported(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    sunk = ("--base", 0.6, -0.7, -0.06, 1, 0, 0, 0, "--start", *UPRIGHT, "--goal", *UPRIGHT)
    answer = run("plan", "--map", map_file, *sunk, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert "more of the mounted link than its foot is in the map; check --base" in answer.out


def test_a_plan_in_a_named_folder_is_kept_without_overwrite(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "plan.json").write_text("{}")
    answer = run("plan", "--map", map_file, *BASE, "--start", "home", "--goal", *GOAL, "--out", out)
    assert answer.code == 2
    assert "holds earlier results (plan.json)" in answer.err
    assert "--overwrite" in answer.err
    assert [path.name for path in out.iterdir()] == ["plan.json"]


@pytest.mark.long
def test_a_map_with_harmonics_and_a_support_plane_is_planned_in_and_drawn(run: RunCommand, tmp_path: Path) -> None:
    model = tabletop().gaussians(4000)
    replace(model, sh=model.sh.repeat(1, 16, 1) * 0.1).save(tmp_path / "map.ply")
    Workspace(T_world_base=np.eye(4), support_plane=np.array([0.0, 0.0, 1.0, 0.0])).save(tmp_path / "scene.yaml")
    words = ("plan", "--map", tmp_path / "map.ply", "--start", "home", "--out", tmp_path / "out", "--overwrite")
    answer = run(*words, "--goal", *GOAL)
    assert answer.code == 0, answer.err
    covers = json.loads((tmp_path / "out" / "plan.json").read_text())["covers"]
    assert covers["support_plane"]
    assert covers["map_gaussians"] == len(model)
    assert cv2.imread(str(tmp_path / "out" / "plan.png")) is not None
    below = run(*words, "--goal-pose", -0.45, 0.2, -0.05, 0, 1, 0, 0)
    assert below.code == 1
    assert "in the support plane of the scene.yaml at" in below.err
    assert run(*words, "--goal", *GOAL, "--no-support").code == 0
    assert not json.loads((tmp_path / "out" / "plan.json").read_text())["covers"]["support_plane"]


def test_the_base_is_taken_from_the_scene_file_of_the_map_and_a_pose_is_reached(
    run: RunCommand, map_file: Path, tmp_path: Path
) -> None:
    assert run("plan", "--map", map_file, "--start", "home", "--goal", *GOAL).code == 2
    T = np.eye(4)
    T[:3, 3] = [0.0, 0.0, 0.05]
    Workspace(T_world_base=T).save(tmp_path / "scene.yaml")
    tool = panda().tcp(np.array(GOAL))
    from splatbot.geometry import rotation_to_quat

    pose = [*tool[:3, 3], *rotation_to_quat(tool[:3, :3])]
    out = tmp_path / "out"
    answer = run(
        "plan", "--map", map_file, "--start", "home", "--goal-pose", *pose, "--margin", 0.01, "--out", out,
        "--budget-ms", 300,
    )  # fmt: skip
    assert answer.code == 0, answer.err
    summary = json.loads((out / "plan.json").read_text())
    np.testing.assert_allclose(panda().tcp(np.array(summary["waypoints"][-1])), tool, atol=1e-4)
    assert summary["margin_m"] == 0.01


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--start", "home"), "--goal, --goal-pose"),
        (("--start", "there", "--goal", "home"), "--start: is there"),
        (("--start", 0.1, 0.2, "--goal", "home"), "--start: has 2 values"),
        (("--start", "home", "--goal", "home", "--margin", "wide"), "--margin"),
        (("--start", "home", "--goal", "home", "--margin", "auto"), "run folder"),
        (("--start", "home", "--goal", *([9.0] * 7)), "goal: "),
        (("--start", "home", "--goal-pose", 5, 0, 0, 1, 0, 0, 0), "goal: "),
        (("--start", "home", "--goal", "home", "--robot", "nobody"), "robot"),
    ],
)
def test_what_cannot_be_planned_is_said(
    words: tuple[object, ...], message: str, run: RunCommand, map_file: Path
) -> None:
    assert_refused(run("plan", "--map", map_file, *BASE, *words), message)


def test_two_numbers_of_a_margin_have_a_reason_and_equal_ones_are_printed_once() -> None:
    covers = {"margin_from": "audit", "confidence": 0.999, "region_points": 61491, "region_error_m": 0.0033}
    text = _margin_text(covers | {"margin_m": 0.0036})
    assert "within 3.3 mm of the map; the margin of 3.6 mm is that of the points near start and goal" in text
    assert _margin_text(covers | {"margin_m": 0.0033}).endswith("within 3.3 mm of the map")
    few = _margin_text(covers | {"margin_m": 0.0033, "region_points": 1000, "confidence": 0.999})
    assert few.startswith("audited: the 1000 measured points nearest to the motion")
