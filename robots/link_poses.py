"""Masks of a robot from the poses of its links in TF."""

from __future__ import annotations

import numpy as np

from splatbot.frame import Frame
from splatbot.geometry import inverse
from splatbot.logs.ros_frames import RosFrame
from splatbot.mapping.selfmask import REACH, JointsUnknownError, SelfMask
from splatbot.protocols import Array
from splatbot.robots.link_frames import LinkFrames
from splatbot.robots.robot import RobotModel, joint_transform
from splatbot.robots.tf_buffer import TransformBuffer

_TILT = 0.05  # [rad] by which the axis of a joint in TF may differ from the model


class LinkPoses:
    """Poses of a robot's links by TF at the times of images.

    Args:
        robot: the robot.
        transforms: of TF.
        prefix: of the names of its links.
    """

    def __init__(self, robot: RobotModel, transforms: TransformBuffer, prefix: str = "") -> None:
        self._robot, self.transforms = robot, transforms
        self.frames = None if robot.link_frames is None else robot.link_frames.prefixed(prefix)

    def __bool__(self) -> bool:
        """Return whether the links have names, and there are transforms."""
        return self.frames is not None and len(self.transforms) > 0

    def mask(self, mask: SelfMask, frame: Frame, stamp: float, wait_s: float = 0.0) -> Frame:
        """Return the frame with the robot at a stamp [s] removed from its mask; wait up to ``wait_s`` [s] for TF.

        The pose of the camera is that of the mask, and the links are moved by its joint offsets. If the mask has no
        pose, it is that of the image's frame in TF, and the links are those of TF.

        Raises:
            JointsUnknownError: the poses of links or camera are not known at that time, or do not fit the model.
        """
        frames = self._named()
        if mask.has_camera:
            reported = self._at(frames, frames.names[0], stamp, wait_s)
            return mask.at_poses(frame, _at_true_positions(reported, self._robot, mask.joint_offsets))
        camera_frame = frame.camera_frame if isinstance(frame, RosFrame) else ""
        if not camera_frame:
            hint = "set header.frame_id of the images, or give T_link_camera (scene.yaml; robot of POST /v1/maps)"
            raise JointsUnknownError("the images name no frame of their camera.", field="frame_id", hint=hint)
        return mask.at_poses(frame, self._at(frames, camera_frame, stamp, wait_s), np.eye(4))

    def _named(self) -> LinkFrames:
        if self.frames is None:
            hint = "add its URDF or MJCF again: splatbot robot add FILE --overwrite, or publish its joint states"
            problem = f"TF cannot mask {self._robot.name}: its stored file does not name its links."
            raise JointsUnknownError(problem, field="tf", hint=hint)
        return self.frames

    def _at(self, frames: LinkFrames, target: str, stamp: float, wait_s: float) -> Array:
        """Return the poses T_target_link (J + 1, 4, 4) of the model's links [m], which fit the model."""
        T = np.asarray(self.transforms.poses(target, frames.names, stamp, wait_s) @ frames.T_frame_link)
        for k, joint in enumerate(self._robot.joints):
            moved = inverse(T[k] @ joint.T_before_joint) @ T[k + 1]
            away = float(np.linalg.norm(moved[: 2 if joint.prismatic else 3, 3]))
            if away > REACH or moved[2, 2] < np.cos(_TILT):
                tilt = float(np.arccos(np.clip(moved[2, 2], -1.0, 1.0)))
                where = f"{frames.names[k + 1]} in TF is {100 * away:.1f} cm and {tilt:.2f} rad"
                hint = "name the robot that publishes TF, or publish its joint states"
                problem = f"{where} from the model of {self._robot.name}."
                raise JointsUnknownError(problem, field="tf", hint=hint)
        return T


def _at_true_positions(T: Array, robot: RobotModel, offsets: Array) -> Array:
    """Return the poses (J + 1, 4, 4) at q + δ of links with poses T at reported positions q.

    With the transform D of a joint, D(q + δ) = D(q) D(δ), so that T'_k+1 = T'_k T_k⁻¹ T_k+1 D(δ_k).
    """
    true = T.copy()
    for k, joint in enumerate(robot.joints):
        true[k + 1] = true[k] @ inverse(T[k]) @ T[k + 1] @ joint_transform(offsets[k], joint.prismatic)
    return true
