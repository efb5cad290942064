"""The service's own news as ROS topics."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

from splatbot.frame import Frame
from splatbot.grasping.types import GraspResult
from splatbot.logs.mcap import COLOR, DEPTH, INFO, JOINTS
from splatbot.logs.ros_frames import camera_info_message, image_message
from splatbot.logs.ros_types import Message
from splatbot.planning import JointTrajectory
from splatbot.services.bus import Bus
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.messages import (
    CAMERA_FRAME,
    MAP_FRAME,
    camera_path_message,
    grasps_message,
    joint_trajectory_message,
    joints_message,
    log_message,
    odometry_message,
    path_message,
    point_cloud_message,
    transform_message,
)
from splatbot.services.store import ServedMap
from splatbot.services.threads import join_started
from splatbot.services.topics import FRAME, GRASPS, PLAN, REMOVED, RESULT, STATE, TRAJECTORY, JointState, arm_topic
from splatbot.services.topics import JOINTS as ARM_JOINTS
from splatbot.slam import FrameResult
from splatbot.trajectory import Trajectory

FROM_ROS = "rosbridge"  # Frame.source of frames that came as ROS messages: they are on the graph already
ODOMETRY, POINTS, PATH, MARKERS, PLANNED, TF, ROSOUT = (
    "/odom",
    "/map/points",
    "/map/path",
    "/map/markers",
    "/planned_path",
    "/tf",
    "/rosout",
)
GRASP_MARKERS = "/grasps/markers"
TYPES = {
    COLOR: "sensor_msgs/msg/Image",
    DEPTH: "sensor_msgs/msg/Image",
    INFO: "sensor_msgs/msg/CameraInfo",
    ODOMETRY: "nav_msgs/msg/Odometry",
    TF: "tf2_msgs/msg/TFMessage",
    POINTS: "sensor_msgs/msg/PointCloud2",
    PATH: "nav_msgs/msg/Path",
    MARKERS: "visualization_msgs/msg/MarkerArray",
    GRASP_MARKERS: "visualization_msgs/msg/MarkerArray",
    PLANNED: "trajectory_msgs/msg/JointTrajectory",
    JOINTS: "sensor_msgs/msg/JointState",
    ROSOUT: "rcl_interfaces/msg/Log",  # Foxglove takes a rosbridge for ROS 2 only where there is one
}

_WAITING = 64  # news that may wait for conversion

_log = logging.getLogger(__name__)


class RosPublishers:
    """A thread that converts the bus's messages to ROS; its delays do not reach the publishers.

    The map "default", or else the first map on the bus, has the plain names; another map's begin with
    `/maps/ID`.

    Args:
        bus: source of the messages.
        graph: where ROS programs read it.
    """

    def __init__(self, bus: Bus, graph: RosGraph) -> None:
        self._graph = graph
        self._main: str | None = None
        self._convert: dict[str, Callable[[str, Any], None]] = {
            FRAME: self._frame,
            RESULT: self._result,
            STATE: self._state,
            TRAJECTORY: self._trajectory,
            PLAN: self._plan,
            GRASPS: self._grasps,
        }
        for topic, kind in TYPES.items():
            graph.advertise(topic, kind)
        self._news = bus.subscribe("maps/*", "robot/*/joints", arm_topic("*", ARM_JOINTS), capacity=_WAITING)
        self._thread = threading.Thread(target=self._run, name="ros-outlets", daemon=True)
        self._rosout = _RosoutHandler(graph)

    def start(self) -> None:
        """Begin."""
        logging.getLogger("splatbot").addHandler(self._rosout)
        self._thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End."""
        logging.getLogger("splatbot").removeHandler(self._rosout)
        self._news.close()
        join_started([self._thread], timeout_s)

    def _run(self) -> None:
        for news in self._news:
            try:
                what, name, kind = news.topic.split("/", 2)
                if isinstance(news.value, JointState):
                    prefix = f"/{name}" if what == "arms" else ""
                    self._graph.publish(prefix + JOINTS, joints_message(news.value))
                elif kind == REMOVED:
                    self._forget(name)
                elif kind in self._convert:
                    self._convert[kind](self._prefix(name), news.value)
            except Exception:  # one odd message must not silence the others
                _log.exception("%s could not be published to ROS", news.topic)

    def _prefix(self, map_id: str) -> str:
        if self._main is None or map_id == "default":
            self._main = map_id
        return "" if map_id == self._main else f"/maps/{map_id.replace('-', '_')}"

    def _forget(self, map_id: str) -> None:
        """Remove the topics of a deleted map; if it was the main one, the plain names are free for the next."""
        prefix = self._prefix(map_id)
        if prefix:
            self._graph.remove_topics(f"{prefix}/")
        else:
            self._main = None
            for topic in (POINTS, PATH, MARKERS, PLANNED, GRASP_MARKERS):
                self._graph.unlatch(topic)

    def _publish(self, prefix: str, topic: str, make: Callable[[], Message], *, latched: bool = False) -> None:
        self._graph.publish_later(prefix + topic, TYPES[topic], make, latched=latched)

    def _frame(self, prefix: str, frame: Frame) -> None:
        if frame.source == FROM_ROS:
            return
        self._publish(prefix, INFO, lambda: camera_info_message(frame.stamp, frame.camera, CAMERA_FRAME))
        self._publish(prefix, COLOR, lambda: image_message(frame.stamp, frame.rgb, CAMERA_FRAME))
        self._publish(prefix, DEPTH, lambda: image_message(frame.stamp, frame.depth, CAMERA_FRAME))

    def _result(self, prefix: str, result: FrameResult) -> None:
        T = result.T_world_camera
        if T is not None:
            self._publish(prefix, ODOMETRY, lambda: odometry_message(result))
            self._publish(prefix, TF, lambda: transform_message(result.stamp, T, MAP_FRAME, CAMERA_FRAME))

    def _state(self, prefix: str, served: ServedMap) -> None:
        snapshot = served.snapshot
        if snapshot is not None:
            self._publish(prefix, POINTS, lambda: point_cloud_message(snapshot.model, snapshot.stamp), latched=True)

    def _trajectory(self, prefix: str, trajectory: Trajectory) -> None:
        self._publish(prefix, PATH, lambda: path_message(trajectory), latched=True)
        self._publish(prefix, MARKERS, lambda: camera_path_message(trajectory), latched=True)

    def _plan(self, prefix: str, plan: JointTrajectory) -> None:
        self._publish(prefix, PLANNED, lambda: joint_trajectory_message(plan, frame_id=MAP_FRAME), latched=True)

    def _grasps(self, prefix: str, found: GraspResult) -> None:
        self._publish(prefix, GRASP_MARKERS, lambda: grasps_message(found.grasps), latched=True)


class _RosoutHandler(logging.Handler):
    """splatbot's warnings and errors on /rosout."""

    def __init__(self, graph: RosGraph) -> None:
        super().__init__(logging.WARNING)
        self._graph = graph

    def emit(self, record: logging.LogRecord) -> None:
        """Publish a record."""
        try:
            self._graph.publish(ROSOUT, log_message(record.levelno, record.name, record.getMessage(), record.created))
        except Exception:  # as logging treats a handler that fails
            self.handleError(record)
