"""Robots and worlds whose shortest paths are known in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel
from splatbot.planning import Cause, PlanResult
from splatbot.protocols import Array, KinematicChain, LinkSpheres

RADIUS = 0.02  # [m] of the robot's only sphere
SIGMA = 0.1  # [m] of the only Gaussian; its solid is a ball of twice that
AROUND = 2 * SIGMA + RADIUS  # [m] that the sphere's centre must keep from the origin


class Slider:
    """A sphere that slides along x and y, and further slides that move nothing that could collide."""

    name = "slider"

    def __init__(self, joints: int, radius: float = RADIUS, limit: float = 1.0) -> None:
        axes = [np.eye(3)[k % 3] for k in range(joints)]
        frames = [_frame(axis) for axis in axes]
        T = np.tile(np.eye(4), (joints, 1, 1))
        before = np.eye(3)
        for k, frame in enumerate(frames):
            T[k, :3, :3] = before.T @ frame
            before = frame
        ones = np.ones(joints)
        self.chain = KinematicChain(
            tuple(f"slide{k}" for k in range(joints)),
            T,
            np.ones(joints, np.bool_),
            -limit * ones,
            limit * ones,
            ones,
            ones,
            ones,
            ones,
        )
        self.home = 0.0 * ones
        self._radius = radius

    @property
    def self_collision_pairs(self) -> NDArray[np.int32]:
        """None."""
        return np.zeros((0, 2), np.int32)

    def spheres(self, opening: float | None = None) -> LinkSpheres:
        """Return one sphere, on the link that x and y move."""
        return LinkSpheres(np.array([2], np.int32), np.zeros((1, 3)), np.array([self._radius]))


def _frame(axis: Array) -> Array:
    """Return a rotation (3, 3) whose z axis is ``axis``."""
    other = np.eye(3)[(int(np.argmax(axis)) + 1) % 3]
    return np.stack([other, np.cross(axis, other), axis], axis=1)


def ball_world() -> GaussianModel:
    """Return a map of one round Gaussian at the origin."""
    return GaussianModel.from_activated(
        means=np.zeros((1, 3)),
        quats=np.array([[1.0, 0, 0, 0]]),
        scales=np.full((1, 3), SIGMA),
        opacities=np.array([0.9]),
        colors=np.full((1, 3), 0.5),
    )


def cause_of(result: PlanResult) -> Cause:
    """Return the cause of a failure and assert that it exists."""
    assert result.cause is not None
    return result.cause


def around_the_ball(far: float) -> float:
    """Return the length [m] of the shortest path from (-far, 0) to (far, 0): two tangents and an arc."""
    return float(2 * np.sqrt(far**2 - AROUND**2) + AROUND * (np.pi - 2 * np.arccos(AROUND / far)))
