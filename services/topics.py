"""Names of the bus's topics and the types of their values.

| topic | value |
|---|---|
| ``maps/{id}/state`` | :class:`splatbot.services.store.ServedMap`: each published state or change of ``state`` |
| ``maps/{id}/removed`` | :class:`splatbot.services.store.ServedMap`: the map as it was when it was deleted |
| ``maps/{id}/frame`` | :class:`splatbot.frame.Frame`: the frame that the mapper received |
| ``maps/{id}/result`` | :class:`splatbot.slam.FrameResult`: odometry, verdict, keyframe, stage timings |
| ``maps/{id}/cameras/{name}/frame`` and ``result`` | the same of a further camera; those above are of the first one |
| ``maps/{id}/trajectory`` | :class:`splatbot.trajectory.Trajectory`: all poses so far, at each published state |
| ``maps/{id}/plan`` | :class:`splatbot.planning.RobotTrajectory`: the latest planned motion |
| ``maps/{id}/grasps`` | :class:`splatbot.grasping.types.GraspResult`: the grasps that were found last |
| ``jobs/{id}`` | :class:`splatbot.services.jobs.Job`: each change of a job |
| ``motions/{id}`` | :class:`splatbot.protocols.Feedback`: feedback of an arm that follows a trajectory |
| ``robot/{name}/joints`` | :class:`JointState`: the robot's latest joints |
| ``ros/robot`` | topic and message of TF or MoveIt that a ROS client has published |
| ``arms/{name}/joints`` | :class:`JointState`: those of one of the service's arms |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STATE = "state"
REMOVED = "removed"
FRAME = "frame"
RESULT = "result"
TRAJECTORY = "trajectory"
PLAN = "plan"
GRASPS = "grasps"
JOINTS = "joints"
ROS_ROBOT = "ros/robot"


@dataclass(frozen=True, eq=False)
class JointState:
    """Joints of an arm at a time.

    Args:
        stamp: [s].
        names: of the joints.
        position: (J,) [rad or m].
        velocity: (J,) per s; None when unknown.
    """

    stamp: float
    names: tuple[str, ...]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64] | None = None


def map_topic(map_id: str, kind: str) -> str:
    """Return the topic of a map, e.g. ``map_topic("default", RESULT)``; "*" as id makes a pattern for every map."""
    return f"maps/{map_id}/{kind}"


def of_camera(camera_name: str, kind: str) -> str:
    """Return the kind of topic of a camera, e.g. ``of_camera("table", RESULT)``; the first one has an empty name."""
    return f"cameras/{camera_name}/{kind}" if camera_name else kind


def robot_topic(robot: str, kind: str) -> str:
    """Return the topic of a robot, e.g. ``robot_topic("panda", JOINTS)``."""
    return f"robot/{robot}/{kind}"


def arm_topic(arm: str, kind: str) -> str:
    """Return the topic of one of the service's arms; two arms may share a robot model."""
    return f"arms/{arm}/{kind}"


def job_topic(job_id: str) -> str:
    """Return the topic of a job."""
    return f"jobs/{job_id}"


def motion_topic(job_id: str) -> str:
    """Return the topic of an arm's motion."""
    return f"motions/{job_id}"
