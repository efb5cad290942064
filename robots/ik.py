"""Inverse kinematics by the toolbox's Levenberg-Marquardt, from many seeds."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.geometry import so3_log
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel

POSITION, ANGLE = 1e-6, 1e-6  # [m], [rad] that a solution may be off by

Free = Callable[[Array], NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class IkSolutions:
    """Configurations (K, J) within the limits that reach a pose, nearest to the wanted posture first; K may be 0.

    Args:
        q: (K, J).
        tried: how many seeds were tried.
        reached: how many of them reached the pose within the limits; the rest of those not in ``q`` were filtered out.
    """

    q: Array
    tried: int
    reached: int


def solve_ik(
    robot: RobotModel,
    T_base_tcp: ArrayLike,
    *,
    near: ArrayLike | None = None,
    seeds: int = 32,
    seed: int = 0,
    free: Free | None = None,
    apart: float = 0.05,
) -> IkSolutions:
    """All different configurations found that put the tool at ``T_base_tcp`` (4, 4) [m].

    The seeds are the posture ``near``, the robot's home, and random ones; each is solved by the toolbox and polished by
    Newton steps. The same arguments give the same answer.

    Args:
        robot: the arm.
        T_base_tcp: where the tool shall be, in the frame of the base.
        near: (J,) a posture to stay near; home by default.
        seeds: how many to try.
        seed: of the random ones.
        free: called with configurations (K, J), says which of them (K,) may be kept, as free of collision.
        apart: solutions nearer to a better one than this in every joint [rad or m] count as the same.

    Raises:
        InputError: the pose is no rigid transform, or ``near`` does not fit the robot.
    """
    T = np.asarray(T_base_tcp, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-6:
        raise InputError("is no rigid pose.", field="T_base_tcp", hint="give (4, 4) with an orthonormal rotation")
    posture = robot.configurations(robot.home if near is None else near)
    starts = np.concatenate(
        [posture[None], robot.home[None], robot.random(max(0, seeds - 2), np.random.default_rng(seed))]
    )
    found = [q for start in starts[:seeds] if (q := _solve(robot, T, start)) is not None]
    order = sorted(found, key=lambda q: float(np.linalg.norm(q - posture)))
    different: list[Array] = []
    for q in order:
        if all(np.abs(q - other).max() > apart for other in different):
            different.append(q)
    kept = np.array(different).reshape(-1, len(robot))
    if free is not None and len(kept):
        kept = kept[free(kept)]
    return IkSolutions(kept, len(starts[:seeds]), len(found))


def _solve(robot: RobotModel, T: Array, start: Array) -> Array | None:
    answer = _ets(robot).ik_LM(T, q0=start, tol=1e-8, ilimit=60, slimit=1, joint_limits=False)
    q = _wrapped(robot, np.asarray(answer[0] if isinstance(answer, tuple) else answer.q, dtype=np.float64))
    for _ in range(4):
        error = pose_error(robot.tcp(q), T)
        if np.linalg.norm(error[:3]) <= 0.1 * POSITION and np.linalg.norm(error[3:]) <= 0.1 * ANGLE:
            break
        q = q + np.linalg.lstsq(robot.jacobian(q), error, rcond=1e-9)[0]
    error = pose_error(robot.tcp(q), T)
    good = np.linalg.norm(error[:3]) <= POSITION and np.linalg.norm(error[3:]) <= ANGLE
    return q if good and bool(robot.within_limits(q)) else None


def pose_error(T_now: Array, T_wanted: Array) -> Array:
    """What is missing (6,): translation [m] and rotation vector [rad], along the base's axes."""
    return np.concatenate([T_wanted[:3, 3] - T_now[:3, 3], so3_log(T_wanted[:3, :3] @ T_now[:3, :3].T)])


def _wrapped(robot: RobotModel, q: Array) -> Array:
    """Whole turns added to or taken from revolute joints where that brings them within the limits."""
    chain = robot.chain
    middle = (chain.lower + chain.upper) / 2
    turned = q - 2 * np.pi * np.round((q - middle) / (2 * np.pi))
    return np.where(chain.prismatic, q, turned)


@cache
def _ets(robot: RobotModel) -> Any:
    """The robot as the toolbox sees it."""
    toolbox: Any = importlib.import_module("roboticstoolbox")  # seconds: only when it is asked for
    ET = toolbox.ET
    parts = []
    for k, joint in enumerate(robot.joints):
        limits = np.array([joint.lower, joint.upper])
        parts.append(ET.SE3(joint.T_before_joint))
        parts.append(ET.tz(jindex=k, qlim=limits) if joint.prismatic else ET.Rz(jindex=k, qlim=limits))
    return toolbox.ETS([*parts, ET.SE3(robot.T_link_tcp)])
