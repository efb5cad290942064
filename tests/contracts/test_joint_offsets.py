"""The command and the service plan with the joint offsets of a scene alike, for the true arm, in reported positions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.cli.plan import plan
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import rotation_to_quat
from splatbot.logs import open_log
from splatbot.logs.record import record
from splatbot.robots.panda import panda
from splatbot.robots.store import load_robot
from splatbot.services.robots_in_maps import robot_in
from splatbot.services.ros.moveit import robot_place
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace, find_workspace
from tests.contracts.conftest import running
from tests.swept_arm import T_BASE_STATIC_CAMERA

OFFSETS = np.array([0.0, 0.03, -0.02, 0.04, 0.01, -0.03, 0.0])
GOAL = np.array([0.9, -0.3, 0.1, -2.0, 0.2, 1.8, 0.5])  # true positions


def test_the_true_arm_reaches_a_pose_and_is_free_although_the_plan_is_in_reported_positions(tmp_path: Path) -> None:
    file = tmp_path / "map.ply"
    tabletop().gaussians(4000).save(file)
    Workspace(T_world_base=np.eye(4), joint_offsets=OFFSETS, offsets_of="panda").save(tmp_path / "scene.yaml")
    tool = panda().tcp(GOAL)
    x, y, z, qw, qx, qy, qz = (float(value) for value in (*tool[:3, 3], *rotation_to_quat(tool[:3, :3])))
    pose = x, y, z, qw, qx, qy, qz
    out = tmp_path / "plan"
    assert plan(map=file, start=("home",), goal_pose=pose, margin="0.01", budget_ms=300, out=out) == 0
    paths = [np.array([p["positions"] for p in json.loads((out / "trajectory.json").read_text())["points"]])]
    store, model = MapStore(), GaussianModel.load(file)
    scene = find_workspace(file)
    store.add("lab", source="a", state="static", snapshot=Snapshot(model, 1), workspace=scene)
    body = {"goal_pose": {"translation": pose[:3], "quaternion_wxyz": pose[3:]}, "margin": 0.01, "budget_ms": 300}
    with running(ServiceSettings(port=0), store) as service:
        answer = service.client.post("/v1/maps/lab/plans", json=body).json()
        paths.append(np.array([p["positions"] for p in answer["trajectory"]["points"]]))
        checked = service.client.post("/v1/maps/lab/collisions", json={"q": (GOAL - OFFSETS)[None].tolist()}).json()
        ik = service.client.post("/v1/ik", json={"pose": body["goal_pose"], "map": "lab", "near": GOAL.tolist()}).json()
    arm, field = RobotSpheres(panda(), margin=0.009), GaussianCollisionField(model)
    for q in paths:
        np.testing.assert_allclose(q[0], panda().home, atol=1e-12)
        np.testing.assert_allclose(panda().tcp(q[-1] + OFFSETS), tool, atol=1e-4)
        assert panda().within_limits(q).all()
        assert panda().within_limits(q + OFFSETS).all()
        assert not arm.check(field, q + OFFSETS).in_collision.any()
    true = RobotSpheres(panda()).clearance(field, GOAL[None]).distance
    np.testing.assert_allclose(checked["clearance"], true, atol=1e-9)
    np.testing.assert_allclose(panda().tcp(np.array(ik["q"][0]) + OFFSETS), tool, atol=1e-4)
    np.testing.assert_allclose(robot_place(store, "panda")[1].fk(GOAL - OFFSETS), panda().fk(GOAL), atol=1e-12)


def test_a_map_keeps_the_offsets_of_its_request_or_of_its_recording_with_any_base(tmp_path: Path) -> None:
    base = {"translation": [0.0, 0.5, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
    at = T_BASE_STATIC_CAMERA
    mount = {"translation": at[:3, 3].tolist(), "quaternion_wxyz": rotation_to_quat(at[:3, :3]).tolist()}
    robot = {"name": "panda", "T_link_camera": mount, "camera_link": 0, "joint_offsets": OFFSETS.tolist()}
    record(open_log("synthetic:tabletop?frames=2&width=64&height=48"), tmp_path / "desk")
    scene = Workspace(T_world_base=np.eye(4), joint_offsets=2 * OFFSETS, offsets_of="panda")
    scene.save(tmp_path / "desk" / "scene.yaml")
    with running(ServiceSettings(port=0, log_roots=(str(tmp_path),))) as service:
        for body in (
            {"id": "pushed", "robot": robot, "robot_base": base},
            {"id": "desk", "log": "desk", "robot_base": base},
            {"id": "both", "log": "desk", "robot": robot},
            {"id": "left-out", "log": "desk", "robot": {"name": "panda-2f85", "T_link_camera": mount}},
            {"id": "null", "log": "desk", "robot": robot | {"joint_offsets": None}},
        ):
            assert service.client.post("/v1/maps", json=body).status_code in (201, 202)
        served = {name: service.store.get(name) for name in ("pushed", "desk", "both", "left-out", "null")}
    for name, (share, y) in {
        "pushed": (1, 0.5),
        "desk": (2, 0.5),
        "both": (1, 0.0),
        "left-out": (2, 0.0),
        "null": (0, 0.0),
    }.items():
        found = served[name].workspace
        assert found is not None
        assert found.T_world_base is not None
        assert found.T_world_base[1, 3] == y
        q = panda().home
        np.testing.assert_allclose(robot_in(served[name], "panda").fk(q), panda().fk(q + share * OFFSETS), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"joint_offsets": [0.0, 0.0, 0.0, 3.1, 0.0, 0.0, 0.0]}, "of panda_joint4 is 3.1, more than its range"),
        ({"joint_offsets": [0.01] * 6}, "has 6 values"),
        ({"name": "iiwa14"}, "are those of panda, not iiwa14"),
    ],
    ids=["no range", "another number", "of the recording, which has another arm"],
)
def test_offsets_with_which_no_plan_would_begin_make_no_map(tmp_path: Path, changes: dict[str, Any], why: str) -> None:
    record(open_log("synthetic:tabletop?frames=2&width=64&height=48"), tmp_path / "desk")
    scene = Workspace(T_world_base=np.eye(4), joint_offsets=OFFSETS, offsets_of="panda")
    scene.save(tmp_path / "desk" / "scene.yaml")
    robot = {"name": "panda", "T_link_camera": {"translation": [0.0, 0.0, 0.1]}} | changes
    with running(ServiceSettings(port=0, log_roots=(str(tmp_path),))) as service:
        answer = service.client.post("/v1/maps", json={"id": "a", "log": "desk", "robot": robot})
        assert answer.status_code == 422
        assert why in answer.text
        assert service.client.get("/v1/maps").json()["maps"] == []


def test_a_map_of_the_service_refuses_another_arm_with_as_many_joints() -> None:
    store, scene = MapStore(), Workspace(T_world_base=np.eye(4), joint_offsets=OFFSETS, offsets_of="panda")
    store.add("lab", source="a", state="static", snapshot=Snapshot(tabletop().gaussians(400), 1), workspace=scene)
    with running(ServiceSettings(port=0), store) as service:
        for name, status in (("iiwa14", 422), ("panda-2f85", 200)):
            q = load_robot(name).home.tolist()
            answer = service.client.post("/v1/maps/lab/collisions", json={"q": [q], "robot": name})
            assert answer.status_code == status
