"""Up direction from an accelerometer whose axes on the camera are not recorded: TUM text and ROS messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from splatbot.errors import LogError
from splatbot.geometry import so3_exp
from splatbot.logs import open_log
from splatbot.logs.gravity import NAME, measured_up
from splatbot.logs.mcap import record_mcap
from splatbot.trajectory import Trajectory

_UP = np.array([0.2, -0.9, -0.3]) / np.linalg.norm([0.2, -0.9, -0.3])
_AXES = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # from the accelerometer to the camera


def _log(folder: Path, swing: float, noise: float = 0.05) -> Trajectory:
    """Write the accelerometer of a camera that turns by ``swing`` [rad] about all axes, and return its poses."""
    rng = np.random.default_rng(0)
    stamps = np.arange(60) / 30.0
    poses = np.tile(np.eye(4), (60, 1, 1))
    for k, t in enumerate(stamps):
        poses[k, :3, :3] = so3_exp(swing * np.array([np.sin(3 * t), np.sin(2 * t + 1), np.cos(4 * t)]))
    rows = [
        [t, *(_AXES.T @ T[:3, :3].T @ (9.81 * _UP) + rng.normal(0, noise, 3))]
        for t, T in zip(stamps, poses, strict=True)
    ]
    np.savetxt(folder / NAME, rows, header="timestamp ax ay az [m/s^2]")
    return Trajectory(stamps, poses)


def test_the_direction_is_found_although_the_axes_are_unknown(tmp_path: Path) -> None:
    found = measured_up(str(tmp_path), _log(tmp_path, 0.5))
    assert found is not None
    assert np.degrees(np.arccos(np.clip(np.dot(found, _UP), -1, 1))) < 1.0


def test_imu_topics_of_a_recording_give_it_and_those_of_a_gyroscope_do_not(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)  # an independent writer
    types = store.types
    trajectory = _log(tmp_path, 0.5)
    stamps, *force = np.loadtxt(tmp_path / NAME).T
    color = np.zeros((12, 16, 3), np.uint8)
    with Writer(tmp_path / "bag", version=9) as writer:

        def add(topic: str, kind: str, stamp: float, **values: Any) -> None:
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            seconds = int(stamp)
            time = types["builtin_interfaces/msg/Time"](seconds, round((stamp - seconds) * 1e9))
            header = types["std_msgs/msg/Header"](time, "camera")
            message = types[kind](header=header, **values)
            writer.write(known[topic], round(stamp * 1e9), store.serialize_cdr(message, kind))

        def image(encoding: str, pixels: NDArray[Any], step: int) -> dict[str, object]:
            values = {"height": 12, "width": 16, "encoding": encoding, "is_bigendian": 0, "step": step}
            return values | {"data": pixels.view(np.uint8).ravel()}

        known: dict[str, Any] = {}
        vector, none = types["geometry_msgs/msg/Vector3"], np.zeros(9)
        q = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        for stamp, *a in zip(stamps.tolist(), *(f.tolist() for f in force), strict=True):
            imu = {"orientation": q, "orientation_covariance": none, "angular_velocity": vector(0.1, 0.0, 0.0)}
            imu |= {"angular_velocity_covariance": none, "linear_acceleration_covariance": none}
            add("/accel", "sensor_msgs/msg/Imu", stamp, linear_acceleration=vector(*a), **imu)
            add("/gyro", "sensor_msgs/msg/Imu", stamp, linear_acceleration=vector(0.0, 0.0, 0.0), **imu)
            add("/camera/color/image_raw", "sensor_msgs/msg/Image", stamp, **image("rgb8", color, 48))
            depth = np.ones((12, 16), np.float32)
            add("/camera/depth/image_rect_raw", "sensor_msgs/msg/Image", stamp, **image("32FC1", depth, 64))
            roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            K = np.array([20.0, 0, 8, 0, 20, 6, 0, 0, 1])
            info = {"height": 12, "width": 16, "distortion_model": "plumb_bob", "d": np.zeros(5), "k": K}
            info |= {"r": np.eye(3).ravel(), "p": np.zeros(12), "binning_x": 0, "binning_y": 0, "roi": roi}
            add("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", stamp, **info)
    found = measured_up(str(tmp_path / "bag"), trajectory)
    assert found is not None
    assert np.degrees(np.arccos(np.clip(np.dot(found, _UP), -1, 1))) < 1.0


def test_a_recording_with_known_axes_knows_it_without_motion(tmp_path: Path) -> None:
    log = open_log("synthetic:tabletop?width=32&height=24&trajectory=handheld&frames=30&imu=100")
    assert log.ground_truth is not None
    found = measured_up(str(record_mcap(log, tmp_path / "a.mcap")), log.ground_truth)
    assert found is not None
    assert np.degrees(np.arccos(np.clip(np.dot(found, [0, 0, 1]), -1, 1))) < 3.0  # 0.2 m/s² of bias are 1.2° an axis


def test_a_camera_that_hardly_turns_cannot_tell(tmp_path: Path) -> None:
    assert measured_up(str(tmp_path), _log(tmp_path, 0.003)) is None


def test_without_an_accelerometer_there_is_no_answer_and_a_damaged_file_is_named(tmp_path: Path) -> None:
    trajectory = _log(tmp_path, 0.5)
    (tmp_path / NAME).write_text("1.0 a b c\n")
    with pytest.raises(LogError, match="accelerometer"):
        measured_up(str(tmp_path), trajectory)
    (tmp_path / NAME).unlink()
    (tmp_path / "rgb.txt").touch()
    assert measured_up(str(tmp_path), trajectory) is None
