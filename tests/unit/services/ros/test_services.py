"""MoveIt's and nvblox' services on a map."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import pose_from_quat, rotation_to_quat
from splatbot.planning import WaypointMotion, certify_motion
from splatbot.robots.store import load_robot
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.moveit import IK_SERVICE, PLAN_SERVICE, VALIDITY_SERVICE, MoveItServices
from splatbot.services.ros.nvblox import ESDF_SERVICE, NvbloxServices
from splatbot.services.ros.wire import to_json
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace

T_WORLD_BASE = pose_from_quat((0.1, 0.0, 0.02), (1, 0, 0, 0))
PANDA = load_robot("panda")
NAMES = list(PANDA.chain.names)
GOAL = [0.6, -0.5, 0.2, -2.0, 0.1, 1.6, 0.9]


def _ball(at: tuple[float, float, float], radius: float = 0.05) -> GaussianModel:
    return GaussianModel.from_activated(
        means=[at], quats=[[1.0, 0, 0, 0]], scales=[[radius / 2] * 3], opacities=[0.9], colors=[[1.0, 0, 0]]
    )


def _graph(model: GaussianModel, base: Any = T_WORLD_BASE) -> tuple[RosGraph, MapStore]:
    graph, store = RosGraph(), MapStore()
    workspace = Workspace(T_world_base=base) if base is not None else None
    store.add("desk", source="a", state="static", snapshot=Snapshot(model, 1, 2.0), workspace=workspace)
    MoveItServices(graph, store)
    NvbloxServices(graph, store)
    return graph, store


def _call(graph: RosGraph, name: str, **args: Any) -> dict[str, Any]:
    """Call a service as over the wire."""
    return dict(json.loads(to_json(graph.service(name).call(json.loads(json.dumps(args))))))


def _joint_state(q: Any) -> dict[str, Any]:
    return {"joint_state": {"name": NAMES[::-1], "position": list(q)[::-1]}}


def _pose(T: Any) -> dict[str, Any]:
    w, x, y, z = rotation_to_quat(T[:3, :3]).tolist()
    return {
        "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "orientation": {"x": x, "y": y, "z": z, "w": w},
    }


def _joint_goal(q: Any) -> dict[str, Any]:
    return {"joint_constraints": [{"joint_name": n, "position": v} for n, v in zip(NAMES, q, strict=True)]}


def _plan(graph: RosGraph, goal: dict[str, Any], start: Any = PANDA.home, **more: Any) -> dict[str, Any]:
    request = {"start_state": _joint_state(start), "goal_constraints": [goal], "allowed_planning_time": 0.1} | more
    return dict(_call(graph, PLAN_SERVICE, motion_plan_request=request)["motion_plan_response"])


def test_a_plan_to_joints_begins_at_the_start_ends_at_the_goal_and_touches_nothing() -> None:
    model = _ball((0.6, 0.3, 0.75))
    graph, store = _graph(model)
    answer = _plan(graph, _joint_goal(GOAL))
    assert answer["error_code"]["val"] == 1, answer["error_code"]
    trajectory = answer["trajectory"]["joint_trajectory"]
    q = np.array([p["positions"] for p in trajectory["points"]])
    assert trajectory["joint_names"] == NAMES
    np.testing.assert_allclose(q[0], PANDA.home, atol=1e-6)
    np.testing.assert_allclose(q[-1], GOAL, atol=1e-6)
    arm = RobotSpheres(PANDA, T_world_base=T_WORLD_BASE)
    assert not arm.check(GaussianCollisionField(model), q).in_collision.any()
    assert store.bus.latest("maps/desk/plan") is not None


def test_a_plan_to_a_pose_in_the_base_s_frame_brings_the_tool_there() -> None:
    graph, _ = _graph(_ball((2.0, 2.0, 2.0)))
    T = PANDA.tcp(np.array(GOAL))
    goal = {
        "position_constraints": [
            {
                "header": {"frame_id": "panda_link0"},
                "constraint_region": {
                    "primitives": [{"type": 2, "dimensions": [0.002]}],
                    "primitive_poses": [_pose(T)],
                },
            }
        ],
        "orientation_constraints": [
            {"orientation": _pose(T)["orientation"]} | {f"absolute_{a}_axis_tolerance": 0.01 for a in "xyz"}
        ],
    }
    answer = _plan(graph, goal)
    assert answer["error_code"]["val"] == 1, answer["error_code"]
    reached = PANDA.tcp(np.array(answer["trajectory"]["joint_trajectory"]["points"][-1]["positions"]))
    assert np.abs(reached[:3, 3] - T[:3, 3]).max() <= 0.002 + 1e-6


@pytest.mark.parametrize(
    ("start", "goal", "code"),
    [
        (PANDA.home, {}, -16),
        (PANDA.home, {"joint_constraints": [{"joint_name": "panda_joint1", "position": 0.1}]}, -16),
        (PANDA.home, _joint_goal([9.0] * 7), -27),
        (PANDA.home, "goal in the ball", -12),
        (GOAL, "start in the ball", -10),
    ],
)
def test_why_there_is_no_plan_is_told_by_moveit_s_codes(start: Any, goal: Any, code: int) -> None:
    centre = tuple((T_WORLD_BASE @ PANDA.tcp(np.array(GOAL)))[:3, 3].tolist())
    graph, _ = _graph(_ball(centre))
    if isinstance(goal, str):
        goal = _joint_goal(PANDA.home if goal.startswith("start") else GOAL)
    answer = _plan(graph, goal, start)
    assert answer["error_code"]["val"] == code, answer["error_code"]
    assert answer["error_code"]["message"]


def test_where_the_robot_stands_must_be_known() -> None:
    graph, _ = _graph(_ball((1, 1, 1)), base=None)
    answer = _plan(graph, _joint_goal(GOAL))
    assert answer["error_code"]["val"] == -21
    assert "scene.yaml" in answer["error_code"]["message"]


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("path_constraints", {"name": "up", "orientation_constraints": [{"link_name": "hand", "weight": 1.0}]}),
        ("trajectory_constraints", {"constraints": [{"name": "a"}]}),
        ("reference_trajectories", [{"joint_trajectory": [{"joint_names": ["a"]}]}]),
        ("max_cartesian_speed", 0.1),
        ("group_name", "left_arm"),
        ("max_velocity_scaling_factor", 2.0),
        ("max_acceleration_scaling_factor", -1.0),
    ],
)
def test_parts_of_a_planning_request_that_are_not_supported_are_refused_by_name(part: str, value: Any) -> None:
    graph, _ = _graph(_ball((3.0, 0.0, 0.0)))
    response = _plan(graph, _joint_goal(GOAL), **{part: value})
    assert response["error_code"]["val"] == (-15 if part == "group_name" else -16)
    name = part.removeprefix("max_").removesuffix("_scaling_factor")
    assert name in response["error_code"]["message"]
    assert not response["trajectory"]


_AT = {"primitives": [{"type": 2, "dimensions": [0.01]}], "primitive_poses": [_pose(np.eye(4))]}
_POSE = {"position_constraints": [{"constraint_region": _AT}]}


@pytest.mark.parametrize(
    ("goals", "name"),
    [
        ([{"position_constraints": [{"link_name": "panda_link5", "constraint_region": _AT}]}], "link_name"),
        ([_POSE | {"orientation_constraints": [{"link_name": "panda_link5"}]}], "link_name"),
        ([{"position_constraints": [{"constraint_region": _AT}] * 2}], "position_constraints"),
        ([_joint_goal(GOAL) | _POSE], "joint_constraints"),
        ([_joint_goal(GOAL) | {"visibility_constraints": [{"target_radius": 1.0}]}], "visibility_constraints"),
        ([_POSE, _POSE], "goal_constraints"),
        ([_joint_goal(GOAL), _POSE], "joint_constraints"),
        ([{"position_constraints": [{"constraint_region": _AT | {"meshes": [{}]}}]}], "meshes"),
        ([{"position_constraints": [{"constraint_region": _AT | {"primitives": [{"type": 3}]}}]}], "primitives"),
        ([{"joint_constraints": [{"joint_name": "elbow", "position": 0.0}]}], "elbow"),
        ([{"joint_constraints": 2 * _joint_goal(GOAL)["joint_constraints"]}], "twice"),
    ],
)
def test_goals_that_would_be_heeded_in_part_are_refused_by_name(goals: list[Any], name: str) -> None:
    graph, _ = _graph(_ball((3.0, 0.0, 0.0)))
    response = _plan(graph, {}, goal_constraints=goals)
    assert response["error_code"]["val"] == -16
    assert name in response["error_code"]["message"]


@pytest.mark.parametrize(
    "more", [{"ik_link_name": "panda_link5"}, {"robot_state": {"attached_collision_objects": [{"link_name": "hand"}]}}]
)
def test_parts_of_ik_requests_that_are_not_supported_are_refused_by_name(more: dict[str, Any]) -> None:
    graph, _ = _graph(_ball((3.0, 0.0, 0.0)))
    request = {"pose_stamped": {"pose": _pose(PANDA.tcp(np.array(GOAL)))}} | more
    answer = _call(graph, IK_SERVICE, ik_request=request)
    assert answer["error_code"]["val"] == -16
    assert next(iter(more)) in answer["error_code"]["message"]


def test_empty_parts_and_the_scales_of_a_planning_request_are_heeded() -> None:
    graph, _ = _graph(_ball((3.0, 0.0, 0.0)))
    empty = {"path_constraints": {"name": "", "joint_constraints": []}, "group_name": "panda_arm"}

    def last(**more: Any) -> float:
        points = _plan(graph, _joint_goal(GOAL), **empty, **more)["trajectory"]["joint_trajectory"]["points"]
        stamp = points[-1]["time_from_start"]
        return float(stamp["sec"] + 1e-9 * stamp["nanosec"])

    full = {"max_velocity_scaling_factor": 1.0, "max_acceleration_scaling_factor": 1.0}
    assert last() > 2.0 * last(**full)  # the default is a fifth of the limits
    assert last(**full | {"max_velocity_scaling_factor": 0.1}) > 4.0 * last(**full)
    assert last(**full | {"max_acceleration_scaling_factor": 0.01}) > 2.0 * last(**full)


def test_a_planned_trajectory_of_moveit_is_certified_as_a_goal_of_the_arm() -> None:
    graph, store = _graph(_ball((0.5, 0.3, 0.5)))
    points = _plan(graph, _joint_goal(GOAL))["trajectory"]["joint_trajectory"]["points"]
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points]
    motion = WaypointMotion(times, [p["positions"] for p in points])
    certify_motion(motion, RobotSpheres(PANDA, T_world_base=T_WORLD_BASE), store.get("desk").field)


def test_ik_reaches_a_pose_of_the_map_and_avoids_what_is_there_when_asked() -> None:
    T = T_WORLD_BASE @ PANDA.tcp(np.array(GOAL))
    graph, _ = _graph(_ball((2.0, 0.0, 0.5)))
    request = {"robot_state": _joint_state(GOAL), "pose_stamped": {"header": {"frame_id": "map"}, "pose": _pose(T)}}
    answer = _call(graph, IK_SERVICE, ik_request=request | {"avoid_collisions": True})
    assert answer["error_code"]["val"] == 1
    reached = T_WORLD_BASE @ PANDA.tcp(np.array(answer["solution"]["joint_state"]["position"]))
    np.testing.assert_allclose(reached, T, atol=1e-5)
    blocked, _ = _graph(_ball(tuple(T[:3, 3].tolist())))
    assert _call(blocked, IK_SERVICE, ik_request=request)["error_code"]["val"] == 1
    answer = _call(blocked, IK_SERVICE, ik_request=request | {"avoid_collisions": True})
    assert answer["error_code"]["val"] == -31
    request["pose_stamped"] = {"header": {"frame_id": "the moon"}, "pose": _pose(T)}
    assert _call(graph, IK_SERVICE, ik_request=request)["error_code"]["val"] == -21


def test_a_state_in_collision_names_what_touches_what() -> None:
    centre = tuple((T_WORLD_BASE @ PANDA.tcp(np.array(GOAL)))[:3, 3].tolist())
    graph, _ = _graph(_ball(centre))
    answer = _call(graph, VALIDITY_SERVICE, robot_state=_joint_state(GOAL))
    assert (answer["valid"], answer["contacts"][0]["contact_body_2"]) == (False, "map")
    assert answer["contacts"][0]["depth"] > 0.01
    free = _call(graph, VALIDITY_SERVICE, robot_state=_joint_state(PANDA.home))
    assert (free["valid"], free["contacts"]) == (True, [])
    beyond = _call(graph, VALIDITY_SERVICE, robot_state=_joint_state([9.0, *PANDA.home[1:]]))
    assert not beyond["valid"]


def test_the_dense_field_is_a_ball_s_distance() -> None:
    graph, _ = _graph(_ball((0.5, 0.0, 0.5), radius=0.1))
    box = {"aabb_min_m": {"x": 0.3, "y": -0.2, "z": 0.3}, "aabb_size_m": {"x": 0.4, "y": 0.4, "z": 0.4}}
    answer = _call(graph, ESDF_SERVICE, use_aabb=True, frame_id="map", **box)
    assert [(d["label"], d["size"], d["stride"]) for d in answer["esdf_and_gradients"]["layout"]["dim"]] == [
        ("x", 8, 512),
        ("y", 8, 64),
        ("z", 8, 8),
    ]
    distance = np.array(answer["esdf_and_gradients"]["data"]).reshape(8, 8, 8)
    gradient = np.array(answer["gradients"]["data"]).reshape(8, 8, 8, 3)
    at = np.moveaxis(np.indices((8, 8, 8)), 0, -1) * 0.05 + np.array([0.325, -0.175, 0.325]) - [0.5, 0.0, 0.5]
    away = np.linalg.norm(at, axis=-1)
    np.testing.assert_allclose(distance, away - 0.1, atol=1e-4)
    np.testing.assert_allclose(gradient, at / away[..., None], atol=1e-3)


@pytest.mark.parametrize(
    "args",
    [
        {"use_aabb": True, "aabb_size_m": {"x": 1e9, "y": 1e9, "z": 1e9}},
        {"use_aabb": True, "aabb_size_m": {"x": -1, "y": 1, "z": 1}},
        {"frame_id": "moon"},
        {"voxel_size_m": 1e-9},
        {"voxel_size_m": "small"},
    ],
)
def test_a_field_that_makes_no_sense_is_refused(args: dict[str, Any]) -> None:
    graph, _ = _graph(_ball((0.5, 0.0, 0.5)))
    with pytest.raises(InputError):
        _call(graph, ESDF_SERVICE, **args)
