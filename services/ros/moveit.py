"""Planning, inverse kinematics and state checks as MoveIt's services (moveit_msgs) name them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import RobotSpheres
from splatbot.errors import InputError, MapNotFoundError, SplatbotError
from splatbot.geometry import inverse
from splatbot.planning import GaussianRRTStar, JointGoal, PlanResult, PlanStatus, PoseGoal
from splatbot.planning.ik import solve_ik
from splatbot.planning.timing import DEFAULT_SPEED
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.robots.robot import RobotModel
from splatbot.services.margins import margin_source, plan_with_margin
from splatbot.services.plan_obstacles import plan_obstacles
from splatbot.services.robots_in_maps import robot_in
from splatbot.services.ros.graph import RosGraph, Service
from splatbot.services.ros.messages import MAP_FRAME
from splatbot.services.ros.requests import entries, entry, has_content, joints, number, pose, vector
from splatbot.services.store import MapStore, ServedMap
from splatbot.services.topics import PLAN

PLAN_SERVICE, IK_SERVICE, VALIDITY_SERVICE = "/plan_kinematic_path", "/compute_ik", "/check_state_validity"

# Values of moveit_msgs/MoveItErrorCodes; those of the planner are in PlanStatus.
_FRAME_TRANSFORM_FAILURE, _INVALID_GOAL, _INVALID_GROUP_NAME = -21, -16, -15
_BUDGET_MS, _LONGEST_MS = 200.0, 10_000.0
_IGNORED_IN_PLANS = (
    "path_constraints",
    "trajectory_constraints",
    "reference_trajectories",
    "max_cartesian_speed",
    "start_state.attached_collision_objects",
    "start_state.multi_dof_joint_state.joint_names",
)
_IGNORED_IN_IK = (
    "constraints",
    "pose_stamped_vector",
    "ik_link_names",
    "robot_state.attached_collision_objects",
    "robot_state.multi_dof_joint_state.joint_names",
)
_GOALS = ("joint_constraints", "position_constraints", "orientation_constraints", "visibility_constraints")
_SHAPES = {1: (0, 2), 3: (0, 1)}  # types of shape_msgs/SolidPrimitive by the number of their dimensions: sphere, box
_IGNORED_IN_STATES = _IGNORED_IN_IK[-2:]


class MoveItServices:
    """GetMotionPlan, GetPositionIK and GetStateValidity on the maps of a store.

    Poses are in the frame "map" (or "world", or none named) or in the robot's base (`base_link`, the first link). An
    error sets ``error_code``, with the reason as its ``message``.

    Args:
        graph: registers the services.
        store: the maps; "default", or else the first one, answers.
        robot: the arm.
    """

    def __init__(self, graph: RosGraph, store: MapStore, *, robot: str = "panda") -> None:
        self._store, self._name = store, robot
        for name, kind, call in (
            (PLAN_SERVICE, "GetMotionPlan", self.plan),
            (IK_SERVICE, "GetPositionIK", self.ik),
            (VALIDITY_SERVICE, "GetStateValidity", self.validity),
        ):
            graph.serve(name, Service(f"moveit_msgs/srv/{kind}", call))

    def plan(self, args: Mapping[str, Any]) -> dict[str, Any]:
        """Answer moveit_msgs/GetMotionPlan; joint goals, or a position and orientation constraint of the tool."""
        begin = time.perf_counter()
        answer: dict[str, Any] = {"group_name": self._name, "trajectory_start": {}, "trajectory": {}}

        def work() -> dict[str, Any]:
            request = entry(args, "motion_plan_request")
            self._check_supported(request, _IGNORED_IN_PLANS)
            served, robot, base = self._place()
            start = joints(request, "start_state.joint_state", robot)
            goal = self._goal(request, robot, base)
            budget = min(1e3 * number(request, "allowed_planning_time") or _BUDGET_MS, _LONGEST_MS)
            # 0 means "not set" in MoveIt, whose own default is 0.1
            speed = number(request, "max_velocity_scaling_factor") or DEFAULT_SPEED
            acceleration = number(request, "max_acceleration_scaling_factor") or DEFAULT_SPEED
            source = margin_source(served, None)
            around = plan_obstacles(served, robot, base, start, margin=source)

            def search(planner: GaussianRRTStar) -> PlanResult:
                with self._store.searches.running(planner):
                    return planner.plan(start, goal, budget_ms=budget)

            found = plan_with_margin(
                source,
                lambda margin: GaussianRRTStar(around.field(margin), robot, T_world_base=base, margin=margin),
                search,
                start,
                goal,
                confidence=MARGIN.confidence,
                speed=speed,
                acceleration=acceleration,
            )
            around.check(found.result)
            found.result.unwrap()
            trajectory = found.trajectory
            assert trajectory is not None
            self._store.tell(served, PLAN, trajectory)
            return {
                "trajectory_start": {"joint_state": {"name": list(robot.chain.names), "position": start}},
                "trajectory": {"joint_trajectory": trajectory.to_ros()},
            }

        response = answer | coded(work)
        return {"motion_plan_response": response | {"planning_time": time.perf_counter() - begin}}

    def ik(self, args: Mapping[str, Any]) -> dict[str, Any]:
        """Answer moveit_msgs/GetPositionIK: the solution nearest to the seed state."""

        def work() -> dict[str, Any]:
            request = entry(args, "ik_request")
            self._check_supported(request, _IGNORED_IN_IK)
            self._check_tool(request, "ik_link_name")
            served, robot, base = self._place()
            near = joints(request, "robot_state.joint_state", robot)
            wanted = pose(request, "pose_stamped.pose")
            if not self._in_base(request, "pose_stamped.header.frame_id"):
                wanted = inverse(base) @ wanted
            arm = RobotSpheres(robot, T_world_base=base)

            def free(q: NDArray[np.float64]) -> NDArray[np.bool_]:
                return ~arm.check(served.field, q).in_collision

            avoid = bool(entry(request, "avoid_collisions"))
            found = solve_ik(robot, wanted, near=near, free=free if avoid else None)
            if not len(found.q):
                return _code(PlanStatus.NO_IK_SOLUTION, f"{found.reached} of {found.tried} tries reached it, none free")
            return {"solution": {"joint_state": {"name": list(robot.chain.names), "position": found.q[0]}}}

        return {"solution": {}} | coded(work)

    def validity(self, args: Mapping[str, Any]) -> dict[str, Any]:
        """Answer moveit_msgs/GetStateValidity; the contact is the one of least clearance.

        Raises:
            SplatbotError: the request makes no sense, or there is no map: this service has no error code.
        """
        self._check_supported(args, ("constraints", *_IGNORED_IN_STATES))
        served, robot, base = self._place()
        q = joints(args, "robot_state.joint_state", robot)[None]
        arm = RobotSpheres(robot, T_world_base=base)
        verdict, clearance = arm.check(served.field, q), arm.clearance(served.field, q)
        contacts = []
        if verdict.in_collision[0]:
            other = int(verdict.other[0])
            contacts.append(
                {
                    "contact_body_1": f"link{int(verdict.link[0])}",
                    "body_type_1": 0,
                    "contact_body_2": f"link{other}" if other >= 0 else "map",
                    "body_type_2": 0 if other >= 0 else 1,
                    "depth": max(-float(clearance.distance[0]), 0.0),
                }
            )
        inside = bool(robot.within_limits(q)[0])
        limits = [] if inside else [{"result": False, "distance": 0.0}]
        valid = inside and not verdict.in_collision[0]
        return {"valid": valid, "contacts": contacts, "cost_sources": [], "constraint_result": limits}

    def _check_supported(self, request: Any, ignored: tuple[str, ...]) -> None:
        """Check that a request has no part that would be ignored.

        Raises:
            InputError: it has one; the error names it.
        """
        group = entry(request, "group_name") or self._name
        groups = (self._name, f"{self._name}_arm")
        if group not in groups:
            raise UnknownGroupError(f"{str(group)[:80]!r} is unknown.", field="group_name", hint=f"use {groups[1]}")
        for path in ignored:
            if has_content(entry(request, path)):
                raise InputError("is not supported.", field=path, hint="leave it empty")

    def _check_tool(self, request: Any, path: str) -> None:
        """Check that a link is the tool: goals are poses of the tool.

        Raises:
            InputError: it is another link.
        """
        link, tools = entry(request, path) or "tcp", ("tcp", f"{self._name}_tcp", f"{self._name}_hand_tcp")
        if link not in tools:
            hint = f"leave it empty, or name the tool: {tools[-1]}"
            raise InputError(f"{str(link)[:80]!r} is not supported.", field=path.rpartition(".")[2], hint=hint)

    def _place(self) -> tuple[ServedMap, RobotModel, NDArray[np.float64]]:
        return robot_place(self._store, self._name)

    def _in_base(self, args: Any, path: str) -> bool:
        frame = str(entry(args, path) or MAP_FRAME).strip("/")
        if frame in (MAP_FRAME, "world"):
            return False
        if frame in ("base_link", f"{self._name}_link0"):
            return True
        hint = f"use {MAP_FRAME}, world, base_link or {self._name}_link0"
        raise UnknownFrameError(f"{frame[:40]!r} is unknown.", field=path, hint=hint)

    def _goal(self, request: Any, robot: RobotModel, base: NDArray[np.float64]) -> JointGoal | PoseGoal:
        goals = entries(request, "goal_constraints")
        if not goals:
            raise InputError("are missing.", field="goal_constraints", hint="give joint_constraints, or a pose")
        kinds = {kind for goal in goals for kind in _GOALS if entries(goal, kind)}
        if kinds == {"joint_constraints"}:
            return JointGoal(np.stack([_joint_goal(goal, robot) for goal in goals]))
        if unsupported := kinds - {"position_constraints", "orientation_constraints"}:
            hint = "give joints, or a position and an orientation of the tool"
            raise InputError("are not supported together with others.", field=max(unsupported), hint=hint)
        if len(goals) > 1:
            raise InputError("are several poses.", field="goal_constraints", hint="give one pose")
        return self._pose_goal(goals[0], base)

    def _pose_goal(self, goal: Any, base: NDArray[np.float64]) -> PoseGoal:
        at, turn = (_at_most_one(goal, f"{kind}_constraints") for kind in ("position", "orientation"))
        for constraint in (at, turn):
            self._check_tool(constraint, "link_name")
        region = _at_most_one(at, "constraint_region.primitive_poses")
        if region is None:
            raise InputError("has no region.", field="position_constraints", hint="give a primitive and its pose")
        if entries(at, "constraint_region.meshes"):
            raise InputError("are not supported.", field="constraint_region.meshes", hint="give a box or a sphere")
        half = _half_edges(_at_most_one(at, "constraint_region.primitives"))
        centre = vector(region, "position") + vector(at, "target_point_offset")
        if turn is None:
            T, tolerance = pose({"p": {"position": {}, "orientation": {"w": 1.0}}}, "p"), np.full(3, np.pi)
        else:
            T = pose({"p": {"orientation": entry(turn, "orientation")}}, "p")
            tolerance = np.array([number(turn, f"absolute_{axis}_axis_tolerance") for axis in "xyz"])
        T[:3, 3] = centre
        if self._in_base(at, "header.frame_id"):
            T = base @ T
        return PoseGoal(T, position=half, angle=tolerance)


class UnknownFrameError(InputError):
    """A frame is unknown (FRAME_TRANSFORM_FAILURE)."""

    code = _FRAME_TRANSFORM_FAILURE


class UnknownGroupError(InputError):
    """A planning group is unknown (INVALID_GROUP_NAME)."""

    code = _INVALID_GROUP_NAME


def main_map(store: MapStore) -> ServedMap:
    """Return the map that unqualified names of ROS mean: "default", or else the first.

    Raises:
        MapNotFoundError: there is no map.
    """
    maps = store.list()
    if not maps:
        raise MapNotFoundError("there is no map.", hint="start the service with one")
    return next((served for served in maps if served.id == "default"), maps[0])


def robot_place(store: MapStore, robot: str) -> tuple[ServedMap, RobotModel, NDArray[np.float64]]:
    """Return the main map, an arm and its base T_world_base (4, 4) there.

    Raises:
        MapNotFoundError: there is no map.
        FrameError: where the robot stands is not known.
    """
    served = main_map(store)
    known = served.workspace.T_world_base if served.workspace is not None else None
    if known is None:
        hint = "write a scene.yaml next to the map: splatbot info MAP --fit-plane"
        raise UnknownFrameError(f"the robot's base in map {served.id!r} is unknown.", field="base", hint=hint)
    return served, robot_in(served, robot), known


def _joint_goal(goal: Any, robot: RobotModel) -> NDArray[np.float64]:
    constraints = entries(goal, "joint_constraints")
    named = {str(entry(c, "joint_name")): number(c, "position") for c in constraints}
    unknown = sorted(named.keys() - set(robot.chain.names))
    if unknown or len(named) < len(constraints):
        text = f"name {', '.join(unknown)[:200]}" if unknown else "name a joint twice"
        raise InputError(f"{text}.", field="joint_constraints", hint=f"name {', '.join(robot.chain.names)} once")
    missing = [name for name in robot.chain.names if name not in named]
    if missing:
        hint = "constrain every joint"
        raise InputError(f"lack {', '.join(missing)}.", field="joint_constraints", hint=hint)
    return np.array([named[name] for name in robot.chain.names])


def _at_most_one(args: Any, path: str) -> Any:
    """Return the only entry of a list, None if it is empty.

    Raises:
        InputError: there are several, of which all but one would be ignored.
    """
    found = entries(args, path)
    if len(found) > 1:
        raise InputError("are several.", field=path, hint="give one")
    return found[0] if found else None


def _half_edges(primitive: Any) -> NDArray[np.float64]:
    """Return the half edges (3,) [m] of a box, or of the largest cube in a sphere; zeros without a primitive.

    Raises:
        InputError: it is neither.
    """
    size = [number({"size": value}, "size") for value in entries(primitive, "dimensions")] or [0.0]
    if len(size) not in (1, 3) or min(size) < 0.0 or entry(primitive, "type") not in (None, *_SHAPES[len(size)]):
        raise InputError("is neither a box nor a sphere.", field="constraint_region.primitives", hint="give one")
    return np.full(3, size[0] / np.sqrt(3.0)) if len(size) == 1 else 0.5 * np.array(size)


def coded(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the result of ``work`` with a success code, or the code and reason of its error."""
    try:
        return _code(PlanStatus.SUCCESS, "") | work()
    except SplatbotError as error:
        code = _INVALID_GOAL if type(error) is InputError else error.code
        return _code(code, str(error))


def _code(value: int, message: str) -> dict[str, Any]:
    return {"error_code": {"val": int(value), "message": message, "source": "splatbot"}}
