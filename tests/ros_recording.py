"""Recordings of ROS topics in which an arm sweeps before a static camera; rosbags writes them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from splatbot.geometry import inverse, rotation_to_quat
from splatbot.logs.ros_frames import camera_info_message, image_message, joint_state_message
from splatbot.logs.ros_types import build, to_cdr
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.sim.wrist import WristLog
from tests.swept_arm import T_BASE_STATIC_CAMERA, sweep

START = 1.7e9  # [s]
LINKS = tuple(f"panda_link{k}" for k in range(8))
TF, IMAGE = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/Image"


def transforms(stamp: float, edges: Iterable[tuple[str, str, Array]]) -> Any:
    listed = [
        {
            "header": {"stamp": dict(zip(("sec", "nanosec"), divmod(round(stamp * 1e9), 10**9), strict=True)),
                       "frame_id": parent},
            "child_frame_id": child,
            "transform": {
                "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
                "rotation": dict(zip("wxyz", rotation_to_quat(T[:3, :3]).tolist(), strict=True)),
            },
        }
        for parent, child, T in edges
    ]  # fmt: skip
    return build(TF, transforms=listed)


def arm(stamp: float, q: Array, prefix: str = "") -> Any:
    T = panda().fk(q)
    edges = [(prefix + LINKS[k], prefix + LINKS[k + 1], inverse(T[k]) @ T[k + 1]) for k in range(7)]
    return transforms(stamp, edges)


def record_ros(
    path: Path,
    log: WristLog,
    *,
    prefix: str = "",
    tf_until: float = 9.0,
    joints_until: float = 0.0,
    late: float = 0.0,
) -> Path:
    """Record frames without joints, TF of the arm with its static camera, and joint states until a time [s]."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        opened: dict[str, Any] = {}

        def write(topic: str, kind: str, message: Any, stamp: float) -> None:
            if topic not in opened:
                opened[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(opened[topic], round(stamp * 1e9), to_cdr(message))

        T_table_base = np.eye(4)
        T_table_base[:3, 3] = 0.3, -0.2, 0.1
        camera = ("table", "optical", T_table_base @ T_BASE_STATIC_CAMERA)
        fixed = transforms(START, [("table", f"{prefix}panda_link0", T_table_base), camera])
        write("/tf_static", TF, fixed, START)
        for t in np.arange(-0.04, log[len(log) - 1].stamp + 0.1, 0.02):
            q, at = sweep(np.array([t]))[0], START + t + late
            if t < tf_until:
                write("/tf", TF, arm(at, q, prefix), at)
            if t < joints_until:
                state = joint_state_message(at, q, panda().chain.names)
                write("/joint_states", "sensor_msgs/msg/JointState", state, at)
        for frame in log:
            at = START + frame.stamp
            info = camera_info_message(at, frame.camera)
            write("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", info, at)
            for topic, image in (("color", frame.rgb), ("depth", frame.depth)):
                write(f"/camera/{topic}/image_raw", IMAGE, image_message(at, image, "/optical"), at)
    return path
