"""Motion planning of an arm in a map of Gaussians: paths, certificates, trajectories, replanning."""

from splatbot.planning.certify import CertifiedMotion, MotionRefusedError, certify_motion
from splatbot.planning.problem import (
    Cause,
    Certificate,
    Goal,
    GoalError,
    JointGoal,
    Path,
    PlanningError,
    PlanningProblem,
    PlanResult,
    PlanStatus,
    PoseGoal,
    StartError,
)
from splatbot.planning.replan import Replanner, Update
from splatbot.planning.rrt_star import GaussianRRTStar
from splatbot.planning.timing import time_path
from splatbot.planning.trajectory import JointTrajectory, State
from splatbot.planning.waypoints import WaypointMotion

__all__ = [
    "Cause",
    "Certificate",
    "CertifiedMotion",
    "GaussianRRTStar",
    "Goal",
    "GoalError",
    "JointGoal",
    "JointTrajectory",
    "MotionRefusedError",
    "Path",
    "PlanResult",
    "PlanStatus",
    "PlanningError",
    "PlanningProblem",
    "PoseGoal",
    "Replanner",
    "StartError",
    "State",
    "Update",
    "WaypointMotion",
    "certify_motion",
    "time_path",
]
