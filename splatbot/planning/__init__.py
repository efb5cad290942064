"""How the arm gets from one configuration to another among the Gaussians."""

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

__all__ = [
    "Cause",
    "Certificate",
    "GaussianRRTStar",
    "Goal",
    "GoalError",
    "JointGoal",
    "JointTrajectory",
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
    "time_path",
]
