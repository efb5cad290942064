"""A simulated Panda that sweeps over a table in view of a camera, and its true distance to points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import look_at, transform_points
from splatbot.logs.scenes.tabletop import tabletop
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.robots.shapes import Capsule
from splatbot.sim.wrist import WristLog

T_SCENE_BASE = np.array([[0.0, -1, 0, 0.0], [1, 0, 0, -0.55], [0, 0, 1, 0.0], [0, 0, 0, 1]])
START = np.array([0.0, -0.35, 0.0, -2.1, 0.0, 1.9, np.pi / 4])
# A camera that stands on a tripod in front of the arm, to its right, and looks at the table.
T_BASE_STATIC_CAMERA = look_at(np.array([1.05, -0.55, 0.75]), np.array([0.4, 0.05, 0.15]))


def sweep(stamps: Array) -> Array:
    """Return joints (N, 7) [rad] that sweep to and fro over the table every 6 s, at most 0.6 rad/s."""
    phase = 2 * np.pi * np.asarray(stamps)[:, None] / 6.0
    return START + np.sin(phase) * np.array([0.55, 0.1, 0.0, 0.15, 0.0, 0.1, 0.2])


def static_log(seconds: float, *, rate: float = 5.0, width: int = 160, moves: bool = True) -> WristLog:
    """Return frames of the static camera with the arm in view, which sweeps or is at rest."""
    joints = sweep(np.arange(round(seconds * rate)) / rate * moves)
    return WristLog(
        panda(),
        joints,
        tabletop().surfaces,
        T_scene_base=T_SCENE_BASE,
        T_link_camera=T_BASE_STATIC_CAMERA,
        link=0,
        width=width,
        rate=rate,
    )


def distance_to_arm(points: Array, q: Array) -> Array:
    """Compute the distances (P,) [m] of points (P, 3) in the base frame to the true capsules."""
    robot = panda()
    T = robot.fk(q)
    shapes = [(T[s.link], np.array(s.start), np.array(s.end), s.radius) for s in robot.shapes if isinstance(s, Capsule)]
    assert robot.gripper is not None
    for T_finger in robot.gripper.T_link_finger:
        for s in robot.gripper.shapes:
            assert isinstance(s, Capsule)
            open_ = np.array([0.0, robot.gripper.stroke, 0.0])
            shapes.append((T[-1] @ T_finger, np.array(s.start) + open_, np.array(s.end) + open_, s.radius))
    least = np.full(len(points), np.inf)
    for pose, start, end, radius in shapes:
        a, b = transform_points(pose, np.stack([start, end]))
        along = b - a
        share = np.clip((points - a) @ along / max(float(along @ along), 1e-12), 0, 1)
        least = np.minimum(least, np.linalg.norm(points - a - share[:, None] * along, axis=1) - radius)
    return least


def near_the_sweep(means: NDArray[np.floating], T_base_map: Array, configurations: Array) -> int:
    """Count the Gaussians (N, 3) that are within 2 cm of the arm at one of the configurations (C, 7)."""
    points = transform_points(T_base_map, np.asarray(means, np.float64))
    if not len(points):
        return 0
    return int((np.min([distance_to_arm(points, q) for q in configurations], axis=0) < 0.02).sum())
