"""ROS messages of the service's values: the map, the camera's path, the robot, plans.

Frames: "map" is the map's world, "camera" the camera's optical frame (x right, y down, z forward).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.grasping.types import Grasp
from splatbot.logs.ros_frames import header, joint_state_message, pose_message, time_of
from splatbot.logs.ros_types import Message, build
from splatbot.planning import JointTrajectory
from splatbot.protocols import Array
from splatbot.services.topics import JointState
from splatbot.slam import FrameResult
from splatbot.trajectory import Trajectory

MAP_FRAME, CAMERA_FRAME = "map", "camera"

_MAX_POINTS = 20_000  # of a JointTrajectory
_FLOAT32 = 7  # of sensor_msgs/PointField
_SPLAT_FIELDS = ("opacity", "scale_x", "scale_y", "scale_z", "rot_x", "rot_y", "rot_z", "rot_w")
_ARROW, _LINE_STRIP = 0, 4  # of visualization_msgs/Marker


def point_cloud_message(model: GaussianModel, stamp: float, *, splats: bool = True) -> Message:
    """Build a sensor_msgs/PointCloud2 of N Gaussians in the map frame: x y z rgb, one float32 each.

    Args:
        splats: add opacity, scales [m] and the rotation (xyzw): the whole Gaussian but for higher harmonics.
    """
    names = ["x", "y", "z", "rgb", *(_SPLAT_FIELDS if splats else ())]
    table = np.zeros((len(model), len(names)), np.float32)
    with torch.no_grad():
        table[:, :3] = model.means.numpy()
        table[:, 3] = _packed(model.colors.numpy())
        if splats:
            table[:, 4] = model.opacities.numpy()
            table[:, 5:8] = model.scales.numpy()
            table[:, 8:] = torch.nn.functional.normalize(model.quats, dim=1).numpy()[:, [1, 2, 3, 0]]
    return build(
        "sensor_msgs/msg/PointCloud2",
        header=header(stamp, MAP_FRAME),
        height=1,
        width=len(table),
        fields=[{"name": n, "offset": 4 * i, "datatype": _FLOAT32, "count": 1} for i, n in enumerate(names)],
        point_step=4 * len(names),
        row_step=table.nbytes,
        data=table.reshape(-1).view(np.uint8),
        is_dense=True,
    )


def points_of(message: Message) -> dict[str, NDArray[np.float32]]:
    """Return the float32 fields (N,) of a PointCloud2 by name; "rgb" is (N, 3) in 0..1.

    Raises:
        InputError: a field is of another type, or the data are cut short.
    """
    count, step = int(message.width) * int(message.height), int(message.point_step)
    data = np.asarray(message.data, np.uint8)
    if any(f.datatype != _FLOAT32 or f.offset + 4 > step for f in message.fields) or data.size < count * step:
        raise InputError("has fields of another type, or too few bytes.", field="data", hint="send FLOAT32 fields")
    table = data[: count * step].reshape(count, step)
    found = {
        f.name: np.ascontiguousarray(table[:, f.offset : f.offset + 4]).view(np.float32)[:, 0] for f in message.fields
    }
    if "rgb" in found:
        packed = found["rgb"].view(np.uint32)
        found["rgb"] = np.stack([(packed >> shift & 255) / np.float32(255) for shift in (16, 8, 0)], -1)
    return found


def odometry_message(result: FrameResult) -> Message:
    """Build a nav_msgs/Odometry of a tracked frame's camera in the map frame, with the pose's covariance.

    Raises:
        ValueError: the frame was lost.
    """
    if result.T_world_camera is None:
        raise ValueError(f"frame {result.index} was lost")
    covariance = np.zeros((6, 6))
    if result.covariance is not None:  # ROS wants fixed axes of the header's frame
        turn = np.kron(np.eye(2), result.T_world_camera[:3, :3])
        covariance = turn @ result.covariance @ turn.T
    return build(
        "nav_msgs/msg/Odometry",
        header=header(result.stamp, MAP_FRAME),
        child_frame_id=CAMERA_FRAME,
        pose={"pose": pose_message(result.T_world_camera), "covariance": covariance.ravel()},
    )


def transform_message(stamp: float, T_parent_child: ArrayLike, parent: str, child: str) -> Message:
    """Build a tf2_msgs/TFMessage of one transform (4, 4)."""
    pose = pose_message(T_parent_child)
    transform = {"translation": {a: getattr(pose.position, a) for a in "xyz"}, "rotation": pose.orientation}
    stamped = {"header": header(stamp, parent), "child_frame_id": child, "transform": transform}
    return build("tf2_msgs/msg/TFMessage", transforms=[stamped])


def path_message(trajectory: Trajectory) -> Message:
    """Build a nav_msgs/Path of the camera in the map frame."""
    stamp = float(trajectory.stamps[-1]) if len(trajectory) else 0.0
    poses = [
        {"header": header(float(t), MAP_FRAME), "pose": pose_message(T)}
        for t, T in zip(trajectory.stamps, trajectory.T_world_camera, strict=True)
    ]
    return build("nav_msgs/msg/Path", header=header(stamp, MAP_FRAME), poses=poses)


def joints_message(state: JointState) -> Message:
    """Build a sensor_msgs/JointState."""
    message = joint_state_message(state.stamp, state.position, state.names)
    if state.velocity is not None:
        message.velocity = np.asarray(state.velocity, np.float64)
    return message


def joints_of(message: Message) -> JointState:
    """Return the joints of a sensor_msgs/JointState.

    Raises:
        InputError: there are more or fewer positions than names, or one is not finite.
    """
    q = np.asarray(message.position, np.float64)
    if len(q) != len(message.name) or not len(q) or not np.isfinite(q).all():
        raise InputError(f"has {len(q)} values.", field="position", hint="give one finite number for each name")
    velocity = np.asarray(message.velocity, np.float64)
    seconds = message.header.stamp.sec + message.header.stamp.nanosec / 1e9
    return JointState(seconds, tuple(message.name), q, velocity if len(velocity) == len(q) else None)


def joint_trajectory_message(trajectory: JointTrajectory, *, frame_id: str = "") -> Message:
    """Build a trajectory_msgs/JointTrajectory with a point every 10 ms."""
    return build("trajectory_msgs/msg/JointTrajectory", trajectory.to_ros(frame_id=frame_id))


def waypoints_of(message: Message) -> tuple[tuple[str, ...], NDArray[np.float64], NDArray[np.float64]]:
    """Return names, times (N,) [s] and positions (N, J) of a JointTrajectory.

    Raises:
        InputError: it has no points or too many, sizes differ, a value is not finite or the times do not increase.
    """
    if len(message.points) > _MAX_POINTS:
        raise InputError(f"are more than {_MAX_POINTS}.", field="points", hint="send the motion in parts")
    times = np.array([p.time_from_start.sec + p.time_from_start.nanosec / 1e9 for p in message.points])
    sizes = {len(p.positions) for p in message.points}
    if sizes != {len(message.joint_names)} or not message.joint_names:
        hint = f"give {len(message.joint_names)} values in each point"
        raise InputError(f"have {sorted(sizes)} positions.", field="points", hint=hint)
    positions = np.stack([p.positions for p in message.points])
    if not np.isfinite(positions).all() or (np.diff(times) <= 0).any() or times[0] < 0:
        raise InputError("are not finite, or not in order.", field="points", hint="let time_from_start increase")
    return tuple(message.joint_names), times, positions


def camera_path_message(trajectory: Trajectory) -> Message:
    """Build a visualization_msgs/MarkerArray: the camera's path as a line in the map frame."""
    stamp = float(trajectory.stamps[-1]) if len(trajectory) else 0.0
    line = _marker("camera", 0, _LINE_STRIP, (0.005, 0.0), (0.1, 0.8, 1.0), trajectory.positions, stamp)
    return build("visualization_msgs/msg/MarkerArray", markers=[line])


def grasps_message(grasps: Sequence[Grasp]) -> Message:
    """Build a visualization_msgs/MarkerArray: an arrow to the object for each grasp; green marks good ones."""
    arrows = []
    for i, grasp in enumerate(grasps):
        ends = np.stack([grasp.T_world_pregrasp[:3, 3], grasp.T_world_tcp[:3, 3]])
        arrows.append(_marker("grasps", i, _ARROW, (0.004, 0.01), (1.0 - grasp.total, grasp.total, 0.1), ends))
    return build("visualization_msgs/msg/MarkerArray", markers=arrows)


def _marker(
    ns: str,
    number: int,
    kind: int,
    widths: tuple[float, float],
    color: tuple[float, float, float],
    points: Array,
    stamp: float = 0.0,
) -> dict[str, Any]:
    """Build a visualization_msgs/Marker along points (N, 3) [m] in the map frame; ``widths``: shaft and head [m]."""
    return {
        "header": header(stamp, MAP_FRAME),
        "ns": ns,
        "id": number,
        "type": kind,
        "pose": {"orientation": {"w": 1.0}},
        "scale": {"x": widths[0], "y": widths[1]},
        "color": dict(zip("rgb", color, strict=True)) | {"a": 1.0},
        "points": [dict(zip("xyz", point, strict=True)) for point in points.tolist()],
    }


def _packed(colors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pack RGB (N, 3) in 0..1 into the bytes 0x00RRGGBB of a float, which RViz and PCL expect."""
    r, g, b = (np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint32)).T
    return ((r << 16) | (g << 8) | b).view(np.float32)


def log_message(level: int, name: str, text: str, stamp: float) -> Message:
    """Build an rcl_interfaces/Log; ``level`` as of Python's logging, which ROS 2 shares."""
    return build("rcl_interfaces/msg/Log", stamp=time_of(stamp), level=min(level, 50), name=name, msg=text)
