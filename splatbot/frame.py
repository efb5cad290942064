"""One RGB-D observation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.imu import ImuSamples


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Camera pose or motion that a robot reports for a frame, from joints, wheels or an inertial sensor.

    Exactly one of the two poses is given.

    Args:
        covariance: (6, 6) of the twist (translation [m], rotation [rad]) in this frame's camera.
        T_world_camera: (4, 4) in the frame of the map, whose origin is the first camera.
        T_previous_camera: (4, 4) of this camera in that of the frame before.

    Raises:
        InputError: none or both poses are given, one is not rigid, or the covariance is not positive definite.
    """

    covariance: NDArray[np.float64]
    T_world_camera: NDArray[np.float64] | None = None
    T_previous_camera: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        given = [T for T in (self.T_world_camera, self.T_previous_camera) if T is not None]
        if len(given) != 1:
            raise InputError(
                f"{len(given)} poses are given.", field="prior", hint="give T_world_camera or T_previous_camera"
            )
        T, C = np.asarray(given[0], np.float64), np.asarray(self.covariance, np.float64)
        rigid = T.shape == (4, 4) and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
        if not rigid or not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1]):
            raise InputError("is no rigid transform (4, 4).", field="prior", hint="give a rotation and a translation")
        if C.shape != (6, 6) or not np.isfinite(C).all() or not np.allclose(C, C.T) or np.linalg.eigvalsh(C)[0] <= 0:
            raise InputError(
                "is not a positive definite matrix (6, 6).",
                field="prior covariance",
                hint="give variances in m² and rad², none of them 0",
            )


@dataclass(frozen=True)
class Frame:
    """A colour image and the depth registered to it.

    Args:
        stamp: time [s].
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 [m] along the optical axis; 0 is missing. NaN and infinity are taken as missing (ROS
            32FC1 convention).
        camera: intrinsics of both images; undistorted.
        index: position in the log.
        joints: joint positions (n,) [rad] at ``stamp``, where a robot reports them.
        mask: (H, W) bool, True where the pixel may be used; None uses all. Masked pixels (a gripper, the robot's own
            arm) are neither tracked nor mapped.
        prior: robot prior of the pose.
        source: origin of the frame, for messages.
        depth_delay: time [s] by which the depth image is later than ``stamp``, by the stamps of a sensor whose streams
            are not synchronized.
        joint_names: names of ``joints``. If empty, they are in the order of the robot.
        camera_name: name of the camera where several cameras map; empty for the first one.
        imu: samples of the camera's inertial sensor since the previous frame, on the clock of ``stamp``. If None, there
            is no sensor or its axes are unknown.
        depth_joints: positions (n,) [rad] of ``joints`` at the time of depth, where that is another time; NaN where a
            joint is not known.

    Raises:
        InputError: sizes differ, a type is wrong or depth is negative.
    """

    stamp: float
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    camera: Camera
    index: int = 0
    joints: NDArray[np.float64] | None = None
    mask: NDArray[np.bool_] | None = None
    prior: PosePrior | None = None
    source: str = field(default="", compare=False)
    depth_delay: float = 0.0
    joint_names: tuple[str, ...] = ()
    camera_name: str = ""
    imu: ImuSamples | None = field(default=None, compare=False)
    depth_joints: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        where = self.source or f"frame {self.index}"
        size = (self.camera.height, self.camera.width)
        if self.rgb.dtype != np.uint8 or self.rgb.ndim != 3 or self.rgb.shape[2] != 3:
            raise InputError(
                f"is {self.rgb.dtype} {self.rgb.shape}.", file=where, field="rgb", hint="give (H, W, 3) uint8"
            )
        if self.depth.dtype != np.float32 or self.depth.ndim != 2:
            raise InputError(
                f"is {self.depth.dtype} {self.depth.shape}.",
                file=where,
                field="depth",
                hint="give (H, W) float32 in metres",
            )
        if self.rgb.shape[:2] != self.depth.shape:
            raise InputError(
                f"colour is {self.rgb.shape[:2]}, depth is {self.depth.shape} (rows, columns).",
                file=where,
                field="depth size",
                hint="register depth to colour, at the colour image's size",
            )
        if self.rgb.shape[:2] != size:
            raise InputError(
                f"images are {self.rgb.shape[:2]}, the intrinsics are for {size} (rows, columns).",
                file=where,
                field="image size",
                hint="correct width and height of the intrinsics, or resize the images",
            )
        if self.mask is not None and (self.mask.dtype != np.bool_ or self.mask.shape != size):
            raise InputError(
                f"is {self.mask.dtype} {self.mask.shape}.",
                file=where,
                field="mask",
                hint=f"give {size} bool, True where a pixel may be used",
            )
        if self.joint_names and (self.joints is None or len(self.joint_names) != len(self.joints)):
            hint = "name every joint, or none"
            raise InputError(f"has {len(self.joint_names)} names.", file=where, field="joint_names", hint=hint)
        if self.depth_joints is not None and (self.joints is None or len(self.depth_joints) != len(self.joints)):
            hint = "give the joints at both times, as many and in the same order"
            raise InputError(f"has {len(self.depth_joints)} positions.", file=where, field="depth_joints", hint=hint)
        if not np.isfinite(self.depth).all():
            object.__setattr__(self, "depth", np.nan_to_num(self.depth, nan=0.0, posinf=0.0, neginf=0.0))
        if (self.depth < 0).any():
            raise InputError(
                f"has negative values (least {self.depth.min():.4g} m).",
                file=where,
                field="depth",
                hint="depth is the distance along the optical axis in metres, 0 where missing",
            )

    def shifted(self, seconds: float) -> Frame:
        """Return the frame with a time [s] added to its stamps."""
        imu = None if self.imu is None else self.imu.shifted(seconds)
        return replace(self, stamp=self.stamp + seconds, imu=imu)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels (H, W) that have a depth and are not masked."""
        return self.depth > 0 if self.mask is None else (self.depth > 0) & self.mask
