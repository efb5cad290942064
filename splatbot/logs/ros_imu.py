"""Inertial sensors in ROS recordings: messages of sensor_msgs/Imu, and their samples in the axes of the camera."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable

import numpy as np

from splatbot.imu import ImuSamples
from splatbot.logs.ros_frames import seconds_of, to_nanoseconds
from splatbot.logs.ros_types import Message, typestore
from splatbot.protocols import Array

TYPE = "sensor_msgs/msg/Imu"
GYRO, ACCEL = "/camera/gyro/sample", "/camera/accel/sample"  # as realsense-ros names them

_NOT_MEASURED, _UNKNOWN = np.array([-1.0, *8 * [0.0]]), np.zeros(9)  # covariances, as sensor_msgs/Imu defines them

_log = logging.getLogger(__name__)


def imu_messages(samples: ImuSamples, frame_id: str = "camera") -> list[tuple[int, str, Message]]:
    """Return time [ns], topic and message of each sample, in the order of time."""
    rows = [(GYRO, row) for row in samples.gyroscope.tolist()] + [
        (ACCEL, row) for row in samples.accelerometer.tolist()
    ]
    return [(to_nanoseconds(row[0]), topic, _message(topic, row, frame_id)) for topic, row in sorted(rows, key=_stamp)]


class RecordedImu:
    """The Imu messages of a recording.

    A vector whose covariance begins with -1 is not measured (sensor_msgs/Imu), and neither is one that is always 0.
    """

    def __init__(self) -> None:
        self._rates: dict[str, list[tuple[float, ...]]] = defaultdict(list)
        self._forces: dict[str, list[tuple[float, ...]]] = defaultdict(list)
        self._frames: dict[str, str] = {}

    def add(self, topic: str, message: Message) -> None:
        """Add a message of a topic."""
        stamp, w, a = seconds_of(message.header.stamp), message.angular_velocity, message.linear_acceleration
        self._frames[topic] = message.header.frame_id.strip("/")
        if message.angular_velocity_covariance[0] != -1:
            self._rates[topic].append((stamp, w.x, w.y, w.z))
        if message.linear_acceleration_covariance[0] != -1:
            self._forces[topic].append((stamp, a.x, a.y, a.z))

    def accelerations(self) -> dict[str, Array]:
        """Return stamps [s] and specific forces [m/s²] (N, 4) of each topic that measures them, in its own axes."""
        return _measured(self._forces)

    def samples(self, camera: str, static_transform: Callable[[str, str], Array | None]) -> ImuSamples | None:
        """Return the samples in the axes of a camera, or None if no topic has known axes.

        The gyroscope and the accelerometer are the topics with the most samples.

        Args:
            camera: name of the camera's optical frame.
            static_transform: returns T_target_source (4, 4) of two frames, or None.
        """
        chosen = []
        for topics in (_measured(self._rates), _measured(self._forces)):
            turned = [self._turned(topic, rows, camera, static_transform) for topic, rows in topics.items()]
            chosen.append(max((rows for rows in turned if rows is not None), key=len, default=np.zeros((0, 4))))
        return ImuSamples.of(*chosen) if any(map(len, chosen)) else None

    def _turned(
        self, topic: str, rows: Array, camera: str, static_transform: Callable[[str, str], Array | None]
    ) -> Array | None:
        """Return the rows (N, 4) of a topic with vectors in the axes of the camera, or None without a transform."""
        frame = self._frames[topic]
        if frame and frame == camera:
            return rows
        T_camera_imu = static_transform(camera, frame)
        if T_camera_imu is None:
            text = "%s is not used in tracking: no static transform leads from its frame %r to the camera %r"
            _log.warning(text, topic, frame, camera)
            return None
        return np.column_stack([rows[:, 0], rows[:, 1:] @ T_camera_imu[:3, :3].T])


def _measured(topics: dict[str, list[tuple[float, ...]]]) -> dict[str, Array]:
    """Return the rows (N, 4) of the topics whose vectors are not always 0."""
    tables = {topic: np.array(rows).reshape(-1, 4) for topic, rows in sorted(topics.items())}
    return {topic: rows for topic, rows in tables.items() if rows[:, 1:].any()}


def _stamp(row: tuple[str, list[float]]) -> float:
    return row[1][0]


def _message(topic: str, row: list[float], frame_id: str) -> Message:
    """Create a sensor_msgs/Imu of one sensor; orientation and the other sensor are marked as not measured.

    The types are called directly, since the checks of :func:`splatbot.logs.ros_types.build` take 16 times as long.
    """
    types = typestore().types
    seconds, nanoseconds = divmod(to_nanoseconds(row[0]), 10**9)
    vector, zero = types["geometry_msgs/msg/Vector3"](*row[1:]), types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    measures_rate = topic == GYRO
    return types[TYPE](
        header=types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](seconds, nanoseconds), frame_id),
        orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        orientation_covariance=_NOT_MEASURED,
        angular_velocity=vector if measures_rate else zero,
        angular_velocity_covariance=_UNKNOWN if measures_rate else _NOT_MEASURED,
        linear_acceleration=zero if measures_rate else vector,
        linear_acceleration_covariance=_NOT_MEASURED if measures_rate else _UNKNOWN,
    )
