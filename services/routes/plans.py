"""Motions planned among the Gaussians, and configurations that reach a pose."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Path, Request, Response

from splatbot.geometry import inverse
from splatbot.planning import GaussianRRTStar, JointGoal, PlanResult, PoseGoal
from splatbot.planning.ik import solve_ik
from splatbot.services.arms import known_robot
from splatbot.services.codecs import answer, answers, body_of, request_body
from splatbot.services.dependencies import ServedAfterFrames, Service, problems
from splatbot.services.margins import margin_source, plan_with_margin
from splatbot.services.plan_obstacles import check_unknown, plan_obstacles
from splatbot.services.plans import Plan
from splatbot.services.problems import TooLargeError
from splatbot.services.robots_in_maps import arm_in, base_in, is_base_proposed, joints_of, robot_in
from splatbot.services.schemas import BASE_EXAMPLE, IkRequest, PlanRequest
from splatbot.services.topics import PLAN

router = APIRouter(tags=["motion"])

_DOWN = {"translation": [0.4, 0.2, 0.4], "quaternion_wxyz": [0.0, 1.0, 0.0, 0.0]}
_EXAMPLES = {
    "to joints": {"goal": [0.3, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], "base": BASE_EXAMPLE},
    "the tool to a pose": {"goal_pose": _DOWN, "base": BASE_EXAMPLE, "budget_ms": 300},
}
_ANSWER = {
    "id": "0d6c1b7f2a3e4f50",
    "map_version": 12,
    "status": "SUCCESS",
    "code": 1,
    "cost_rad": 1.24,
    "seconds": 0.1,
    "first_seconds": 0.003,
    "duration_s": 1.9,
    "certified": True,
    "clearance_m": 0.05,
    "margin_m": 0.006,
    "margin_source": "audited error of the map where the arm moves",
    "covers": {
        "n_sigma": 2.0,
        "self_collision": True,
        "base": False,
        "base_proposed": False,
        "support_plane": True,
        "measured_surface": True,
        "unknown_space": "free",
        "region_points": 5831,
    },
    "waypoints": [[0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], [0.3, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]],
    "trajectory": {"joint_names": ["panda_joint1"], "points": []},
}
_IK_EXAMPLES = {
    "straight down": {"pose": _DOWN},
    "near a posture": {"pose": _DOWN, "seeds": 16, "near": [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8]},
}
_IK_ANSWER = {"q": [[0.1, 0.2, 0.3, -2.0, 0.0, 1.6, 0.8]], "tried": 32, "reached": 30}
_PlanBody = Annotated[PlanRequest, Depends(body_of(PlanRequest))]


@router.post(
    "/v1/maps/{map_id}/plans",
    response_class=Response,
    responses=answers(_ANSWER) | problems(404, 413, 415, 422, 503),
    openapi_extra=request_body(PlanRequest, _EXAMPLES),
)
def plan(request: Request, served: ServedAfterFrames, service: Service, query: _PlanBody) -> Response:
    """Plan a certified motion; `trajectory` is a ROS JointTrajectory, `id` is for POST /v1/trajectories.

    No motion is a problem (422) whose `code` is that of moveit_msgs/MoveItErrorCodes.
    """
    if query.budget_ms > service.settings.max_plan_ms:
        hint = "give less, or raise SPLATBOT_MAX_PLAN_MS"
        raise TooLargeError(f"is more than {service.settings.max_plan_ms:g}.", field="budget_ms", hint=hint)
    robot, base = robot_in(served, query.robot), base_in(served, query.base)
    start = robot.home if query.start is None else joints_of(robot, query.start, "start")
    goal = (
        PoseGoal(base @ query.goal_pose.matrix("goal_pose"))
        if query.goal_pose is not None
        else JointGoal(joints_of(robot, query.goal or [], "goal"))
    )
    check_unknown(served, query.unknown, query.base)
    source = margin_source(served, query.margin)
    around = plan_obstacles(served, robot, base, start, policy=query.unknown, support=query.support, margin=source)

    def search(planner: GaussianRRTStar) -> PlanResult:
        with service.store.searches.running(planner):
            return planner.plan(start, goal, budget_ms=query.budget_ms, seed=query.seed)

    found = plan_with_margin(
        source,
        lambda margin: GaussianRRTStar(around.field(margin), robot, T_world_base=base, margin=margin),
        search,
        start,
        goal,
        confidence=query.confidence,
        speed=query.speed,
    )
    result, trajectory = found.result, found.trajectory
    around.check(result)
    result.unwrap()
    assert trajectory is not None
    points = len(trajectory.control) - 2 if query.rate is None else trajectory.duration * query.rate
    most = service.settings.max_configurations
    if points > most:
        hint = "give a lower rate or a higher speed, or raise SPLATBOT_MAX_CONFIGURATIONS"
        raise TooLargeError(
            f"makes {points:.0f} points of {trajectory.duration:.4g} s, at most {most} points are answered.",
            field="rate",
            hint=hint,
        )
    proposed = is_base_proposed(served, query.base)
    covers = found.scope(around, confidence=query.confidence) | {"base_proposed": proposed}
    kept = service.plans.add(served, robot.name, base, result, trajectory, source.why, covers)
    service.store.tell(served, PLAN, trajectory)
    return answer(request, _description(kept, query.rate))


@router.get("/v1/plans/{plan_id}", response_class=Response, responses=answers(_ANSWER) | problems(404))
def get_plan(
    request: Request,
    service: Service,
    plan_id: Annotated[str, Path(description="as POST .../plans named it", examples=["0d6c1b7f2a3e4f50"])],
) -> Response:
    """Return a plan; the latest 256 are kept."""
    return answer(request, _description(service.plans.get(plan_id), None))


@router.post(
    "/v1/ik",
    response_class=Response,
    responses=answers(_IK_ANSWER, npy="q (K, J)") | problems(404, 415, 422, 503),
    openapi_extra=request_body(IkRequest, _IK_EXAMPLES),
)
def ik(request: Request, service: Service, query: Annotated[IkRequest, Depends(body_of(IkRequest))]) -> Response:
    """Solve the IK of a tool pose, nearest to `near` first; with `map`, keep solutions that are free in it."""
    robot = known_robot(query.robot)
    pose, free = query.pose.matrix("pose"), None
    version: dict[str, Any] = {}
    if query.map is not None:
        served = service.store.get(query.map)
        robot, arm = arm_in(served, query.robot, query.base, query.margin)
        field = served.field
        pose = inverse(arm.T_world_base) @ pose
        version["map_version"] = served.map_version

        def free(q: Any) -> Any:
            return ~arm.check(field, q).in_collision

    near = None if query.near is None else joints_of(robot, query.near, "near")
    found = solve_ik(robot, pose, near=near, seeds=query.seeds, free=free)
    return answer(request, version | {"q": found.q, "tried": found.tried, "reached": found.reached}, array="q")


def _description(plan: Plan, rate: float | None) -> dict[str, Any]:
    result, trajectory = plan.result, plan.trajectory
    path, certificate = result.unwrap(), trajectory.certificate
    return {
        "id": plan.id,
        "map_version": certificate.map_version,
        "status": result.status.name,
        "code": int(result.status),
        "cost_rad": path.cost,
        "seconds": result.seconds,
        "first_seconds": result.first_seconds,
        "duration_s": trajectory.duration,
        "certified": certificate.certified,
        "clearance_m": certificate.clearance,
        "margin_m": certificate.margin,
        "margin_source": plan.margin_source,
        "covers": plan.covers,
        "waypoints": np.asarray(path.waypoints),
        "trajectory": trajectory.to_ros(rate=rate),
    }
