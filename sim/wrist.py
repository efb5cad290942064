"""Simulated log of a camera on an arm's wrist: the scene and the arm itself, with joints and exact poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.logs.base import LogBase
from splatbot.logs.raycast import Moving, RaycastScene, RaycastSurface
from splatbot.logs.shapes import TriangleMesh, lathe
from splatbot.logs.textures import Texture
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.robots.shapes import Capsule
from splatbot.trajectory import Trajectory

# On a bracket of a Panda's last link, 28 cm from its axis and above the hand, turned 25 degrees towards the fingers.
_TILT = np.radians(25.0)
T_PANDA_CAMERA = np.array(
    [
        [0.0, -np.cos(_TILT), -np.sin(_TILT), 0.28],
        [1.0, 0.0, 0.0, 0.0],
        [0.0, -np.sin(_TILT), np.cos(_TILT), -0.12],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


class WristLog(LogBase):
    """Simulated frames with joints from a camera on a link of a moving arm.

    Args:
        robot: rendered as its capsules.
        joints: (F, J) of each frame.
        surfaces: of the scene, in its own frame.
        T_scene_base: (4, 4) pose of the arm's base in the scene.
        T_link_camera: (4, 4), the camera on its link.
        link: index of the link that carries the camera; -1 is the last one, 0 the base.
        width: [px].
        rate: of the frames [Hz].
        moving: moving objects in the scene, by name.
    """

    def __init__(
        self,
        robot: RobotModel,
        joints: Array,
        surfaces: list[RaycastSurface],
        *,
        T_scene_base: Array,
        T_link_camera: Array = T_PANDA_CAMERA,
        link: int = -1,
        width: int = 320,
        rate: float = 30.0,
        moving: Mapping[str, Moving] | None = None,
    ) -> None:
        self.name, self.uri = "wrist", "wrist"
        height, f = width * 3 // 4, 0.7 * width
        self.camera = Camera(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
        self.robot, self.joints, self.T_scene_base = robot, joints, T_scene_base
        T = T_scene_base @ robot.fk(joints)
        stamps = np.arange(len(joints)) / rate
        self.ground_truth = Trajectory(stamps, T[:, link] @ T_link_camera)
        links = {f"link {k}": Moving(found, _pose_of(stamps, T[:, k])) for k, found in _link_surfaces(robot).items()}
        self.scene = RaycastScene(surfaces, links | dict(moving or {}))

    def __len__(self) -> int:
        return len(self.joints)

    def _decode(self, index: int) -> Frame:
        stamp = float(self.ground_truth.stamps[index])
        rgb, depth = self.scene.render(self.camera, self.ground_truth.T_world_camera[index], stamp)
        return Frame(stamp, rgb, depth, self.camera, index, joints=self.joints[index].copy(), source=f"wrist#{index}")

    def shows_robot(self, index: int) -> NDArray[np.bool_]:
        """Return the pixels (H, W) of a frame that show the arm or a moving object."""
        stamp = float(self.ground_truth.stamps[index])
        return self.scene.moving_mask(self.camera, self.ground_truth.T_world_camera[index], stamp)


def _pose_of(stamps: Array, poses: Array) -> Callable[[float], Array]:
    return lambda t: np.asarray(poses[int(np.argmin(np.abs(stamps - t)))])


def _link_surfaces(robot: RobotModel) -> dict[int, list[RaycastSurface]]:
    """Create surfaces from the capsules of each link, with the fingers open on the last one."""
    found: dict[int, list[RaycastSurface]] = {}
    for number, shape in enumerate(robot.shapes):
        if isinstance(shape, Capsule):
            texture = Texture((0.9, 0.9, 0.92), (0.35, 0.4, 0.5), 0.02, seed=number)
            found.setdefault(shape.link, []).append(
                RaycastSurface(capsule_mesh(shape.start, shape.end, shape.radius), texture)
            )
    if robot.gripper is not None:
        opened = np.array([0.0, robot.gripper.stroke, 0.0])
        for T in robot.gripper.T_link_finger:
            for shape in robot.gripper.shapes:
                if isinstance(shape, Capsule):
                    ends = [T[:3, :3] @ (np.array(p) + opened) + T[:3, 3] for p in (shape.start, shape.end)]
                    mesh = capsule_mesh(ends[0], ends[1], shape.radius)
                    found.setdefault(len(robot), []).append(
                        RaycastSurface(mesh, Texture((0.3, 0.3, 0.3), (0.7, 0.6, 0.2), 0.01))
                    )
    return found


def capsule_mesh(start: ArrayLike, end: ArrayLike, radius: float) -> TriangleMesh:
    """Create a mesh of a capsule between two points (3,) [m]."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    turn = np.linspace(-np.pi / 2, np.pi / 2, 24)
    profile = np.stack([radius * np.cos(turn), radius * np.sin(turn) + np.where(turn > 0, length, 0.0)], axis=1)
    mesh = lathe(profile)
    z = (b - a) / length if length > 0 else np.array([0.0, 0.0, 1.0])
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    return TriangleMesh(mesh.vertices @ np.stack([x, np.cross(z, x), z]) + a, mesh.triangles)
