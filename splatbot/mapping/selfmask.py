"""Self mask: the robot's own body in the image moves with or in front of the camera and is not part of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.collision import RobotSpheres
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import inverse, transform_points
from splatbot.logs.joints import select_joints
from splatbot.protocols import Array, RobotKinematics

REACH = 0.02  # [m] distance from the robot's spheres that counts as the robot
SAME_TIME_S = 1e-3  # [s] between colour and depth in which an arm moves by less than the noise of depth


class JointsUnknownError(InputError):
    """The joints of the robot at the time of a frame are not known, so its pixels are not known either."""

    http_status = 409


class SelfMask:
    """Masks the pixels of frames that may show the robot: within ``reach`` of its spheres at the frame's joints.

    A pixel is masked if its ray meets an enlarged sphere at or in front of the measured depth, or without a measured
    depth. It is also masked if its measured point lies in such a sphere. Objects in front of the robot remain.

    Where depth is of another time than colour, the pixels that may show the robot at one of both times are masked. A
    surface that only one of the images shows is no surface of the scene.

    Args:
        robot: joints, links and the spheres that cover them.
        T_link_camera: (4, 4), the camera on the link that carries it. If None, only poses of links that include the
            camera's mask a frame; see :meth:`at_poses`.
        link: index of the link that carries the camera. -1 is the last one; 0 is the base, for a static camera.
        opening: opening of the gripper [m]. If None, the gripper is fully open.
        reach: enlargement of the spheres [m].
        joint_offsets: (J,) added to measured joint positions [rad or m]; see `splatbot calibrate hand-eye`.
        joint_names: (J,) names of the robot's joints in the frames, if they are not those of its model.
        held: (A, 4) spheres (x, y, z, radius) [m] of an object in the hand, in the frame of the last link.

    Raises:
        InputError: The camera pose is not rigid, the link does not exist, the reach is negative, or offsets or names
            are not one for each joint.
    """

    def __init__(
        self,
        robot: RobotKinematics,
        T_link_camera: ArrayLike | None,
        *,
        link: int = -1,
        opening: float | None = None,
        reach: float = REACH,
        joint_offsets: ArrayLike | None = None,
        joint_names: Sequence[str] = (),
        held: ArrayLike | None = None,
    ) -> None:
        links = len(robot.chain) + 1
        if not -links <= link < links:
            raise InputError(f"is {link}.", field="link", hint=f"{robot.name} has links 0..{links - 1}")
        if not 0.0 <= reach < np.inf:
            raise InputError(f"is {reach}.", field="reach", hint="give metres, 0 or more")
        T = None if T_link_camera is None else np.asarray(T_link_camera, dtype=np.float64)
        if T is not None and not _is_rigid(T):
            raise InputError(
                "is no rigid pose.", field="T_link_camera", hint="give (4, 4) with an orthonormal rotation"
            )
        self.joint_offsets = np.zeros(links - 1) if joint_offsets is None else np.asarray(joint_offsets, np.float64)
        if self.joint_offsets.shape != (links - 1,) or not np.isfinite(self.joint_offsets).all():
            shape = self.joint_offsets.shape
            raise InputError(f"is {shape}.", field="joint_offsets", hint=f"{robot.name} has {links - 1} joints")
        self._names = tuple(joint_names) or tuple(robot.chain.names)
        if len(self._names) != links - 1:
            hint = f"{robot.name} has {links - 1} joints"
            raise InputError(f"has {len(self._names)} names.", field="joint_names", hint=hint)
        self._arm = RobotSpheres(robot, opening=opening, attached=held)
        self._T_link_camera, self._link, self._reach = T, link % links, reach
        self._radii = self._arm.spheres.radii + reach

    @property
    def has_camera(self) -> bool:
        """Return whether the pose of the camera on its link is known."""
        return self._T_link_camera is not None

    def __call__(self, frame: Frame) -> Frame:
        """Return the frame with the robot at the times of colour and of depth removed from its mask.

        Raises:
            JointsUnknownError: The frame has no joints or too few at one of both times.
        """
        masked = self.at_joints(frame, frame.joints, frame.joint_names)
        if abs(frame.depth_delay) <= SAME_TIME_S:
            return masked
        return self.at_joints(masked, frame.depth_joints, frame.joint_names, time="the time of depth")

    def usable(self, frame: Frame) -> NDArray[np.bool_]:
        """Compute the pixels (H, W) that do not show the robot at the frame's stamp.

        Raises:
            JointsUnknownError: The frame has no joints or too few.
        """
        return self._free(frame, frame.joints, frame.joint_names, "its time")

    def at_joints(
        self,
        frame: Frame,
        joints: NDArray[np.float64] | None,
        names: Sequence[str],
        *,
        time: str = "its time",
    ) -> Frame:
        """Return the frame with the robot at given joint positions removed from its mask.

        Args:
            frame: the frame; its joints do not count.
            joints: positions (n,) [rad or m], or None where they are not known.
            names: of ``joints``; if empty, they are in the order of the robot.
            time: of the positions, for messages.

        Raises:
            JointsUnknownError: a joint is not known.
        """
        return _narrowed(frame, self._free(frame, joints, names, time))

    def _free(
        self, frame: Frame, joints: NDArray[np.float64] | None, names: Sequence[str], time: str
    ) -> NDArray[np.bool_]:
        """Compute the pixels (H, W) that do not show the robot at joint positions (n,)."""
        where = frame.source or f"frame {frame.index}"
        hint = (
            f"record the joints of {self._arm.robot.name} at 10 Hz or more, leave such frames out "
            "(--on-bad-frame skip), or map without its mask"
        )
        if joints is None:
            raise JointsUnknownError(f"has no joints at {time}.", file=where, field="joints", hint=hint)
        try:
            q = select_joints(names, joints, self._names) + self.joint_offsets
        except InputError as error:
            raise JointsUnknownError(error.message, file=where, field=error.field, hint=error.hint) from error
        if not np.isfinite(q).all():
            missing = self._names[int(np.argmin(np.isfinite(q)))]
            raise JointsUnknownError(f"has no joint {missing} at {time}.", file=where, field="joints", hint=hint)
        return self._seen(frame, self._arm.forward(q)[0], None)

    def at_poses(self, frame: Frame, T_link: ArrayLike, T_camera: ArrayLike | None = None) -> Frame:
        """Return the frame with the robot at given poses removed from its mask.

        Args:
            frame: the frame; its joints do not count.
            T_link: (J + 1, 4, 4) poses of the links in any frame.
            T_camera: (4, 4) pose of the camera in the same frame. If None, it is that on its link.

        Raises:
            JointsUnknownError: the pose of the camera is not given, and not known on its link.
        """
        return _narrowed(frame, self._seen(frame, np.asarray(T_link, np.float64), T_camera))

    def _seen(self, frame: Frame, T_link: Array, T_camera: ArrayLike | None) -> NDArray[np.bool_]:
        """Compute the pixels (H, W) that do not show the robot at poses (J + 1, 4, 4) of its links."""
        if T_camera is None and self._T_link_camera is None:
            hint = "write T_link_camera to scene.yaml, or publish TF of the camera's frame"
            raise JointsUnknownError("the pose of the camera is not known.", field="T_link_camera", hint=hint)
        T = T_link[self._link] @ self._T_link_camera if T_camera is None else np.asarray(T_camera, np.float64)
        at = T_link[self._arm.spheres.link]
        centers = np.einsum("sij,sj->si", at[:, :3, :3], self._arm.spheres.centers) + at[:, :3, 3]
        centers = transform_points(inverse(T), centers)
        hidden = np.zeros(frame.depth.shape, np.bool_)
        for center, radius in zip(centers, self._radii, strict=True):
            _hide(hidden, frame.depth, frame.camera, center, float(radius))
        return ~hidden


def knows_joints(frame: Frame) -> bool:
    """Return whether a frame has joints of its own at the times of both of its images."""
    moved = abs(frame.depth_delay) > SAME_TIME_S
    return frame.joints is not None and not (moved and frame.depth_joints is None)


def _narrowed(frame: Frame, free: NDArray[np.bool_]) -> Frame:
    """Return the frame with a mask of the pixels (H, W) that were usable and are free."""
    return replace(frame, mask=free if frame.mask is None else frame.mask & free)


def _is_rigid(T: Array) -> bool:
    rotation = T[:3, :3] if T.shape == (4, 4) and np.isfinite(T).all() else np.zeros((3, 3))
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() <= 1e-6)


def _hide(hidden: NDArray[np.bool_], depth: NDArray[np.float32], camera: Camera, center: Array, radius: float) -> None:
    """Mark the pixels whose ray meets a sphere (camera frame) not farther than their depth, or ends in it."""
    rows, columns = _window(camera, center, radius)
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    x = (np.arange(columns.start, columns.stop) - camera.cx) / camera.fx
    y = (np.arange(rows.start, rows.stop)[:, None] - camera.cy) / camera.fy
    z = depth[rows, columns].astype(np.float64)
    # Along (x, y, 1) s: a s² - 2 b s + c = 0 on the sphere.
    a, b, c = x * x + y * y + 1.0, x * center[0] + y * center[1] + center[2], float(center @ center) - radius**2
    under = b * b - a * c
    root = np.sqrt(np.maximum(under, 0.0))
    near, far = (b - root) / a, (b + root) / a
    measured = z > 0
    inside = measured & (z >= near) & (z <= far)
    before = (near > 0.0) & (~measured | (near <= z))
    hidden[rows, columns] |= (under > 0.0) & (inside | before)


def _window(camera: Camera, center: Array, radius: float) -> tuple[slice, slice]:
    """Compute the rows and columns of a sphere's bounding box; the whole image if it reaches behind the camera."""
    whole = slice(0, camera.height), slice(0, camera.width)
    if center[2] + radius <= 0.0:
        return slice(0, 0), slice(0, 0)
    if center[2] - radius <= 1e-3:
        return whole
    nearest, farthest = center[2] - radius, center[2] + radius
    found = []
    for k, f, c, size in ((1, camera.fy, camera.cy, camera.height), (0, camera.fx, camera.cx, camera.width)):
        low, high = center[k] - radius, center[k] + radius
        first = f * (low / (nearest if low < 0 else farthest)) + c
        last = f * (high / (nearest if high > 0 else farthest)) + c
        found.append(slice(max(0, int(np.floor(first))), min(size, int(np.ceil(last)) + 1)))
    return found[0], found[1]
