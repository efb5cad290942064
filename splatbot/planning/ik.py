"""Inverse kinematics for plans, Cartesian lines, the service and the simulator: one solver, one tolerance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot._native import Arm
from splatbot._native import inverse_kinematics as _levenberg_marquardt
from splatbot.errors import InputError
from splatbot.protocols import Array, KinematicChain


@dataclass(frozen=True)
class IKConstants:
    """Constants of inverse kinematics.

    Args:
        max_error: [m] and [rad] largest error of a solution in translation and in rotation.
        max_starts: largest number of starts before a pose counts as unreachable.
        max_iterations: largest number of Levenberg-Marquardt steps from one start.
    """

    max_error: float = 1e-6
    max_starts: int = 512
    max_iterations: int = 80


CONSTANTS = IKConstants()


CollisionFilter = Callable[[Array], NDArray[np.bool_]]
"""Maps configurations (K, J) to (K,), True where a configuration is free."""


@runtime_checkable
class HasTool(Protocol):
    """A robot with a tool."""

    @property
    def T_link_tcp(self) -> Array:
        """Pose (4, 4) of the tool in the frame of the last link [m]."""
        ...


@runtime_checkable
class ArmWithTool(HasTool, Protocol):
    """An arm for :func:`solve_ik`."""

    @property
    def chain(self) -> KinematicChain:
        """Joints and their limits."""
        ...

    @property
    def home(self) -> Array:
        """Posture (J,) [rad or m] that is the first start if no other is given."""
        ...

    def configurations(self, q: ArrayLike) -> Array:
        """Return ``q`` as finite float64 (..., J).

        Raises:
            InputError: ``q`` has another number of joints, or a value is not finite.
        """
        ...


@dataclass(frozen=True, eq=False)
class IkSolutions:
    """Distinct configurations that place the tool at a pose.

    Args:
        q: (K, J) [rad or m] within the limits, sorted by distance from ``near``; K is 0 if no start reaches the pose.
        tried: number of starts.
        reached: number of starts that converge within the limits, before duplicates and collisions are removed.
    """

    q: Array
    tried: int
    reached: int


def inverse_kinematics(
    arm: Arm, chain: KinematicChain, T_link_tcp: ArrayLike, T_world_tcp: Array, starts: Array
) -> tuple[Array, Array]:
    r"""Move each start towards its pose within the joint limits.

    The native solver takes Levenberg-Marquardt steps whose damping grows with the squared error (Sugihara, T-RO 2011)::

        e  = (p* - p, log(R* R^T)),   λ = 0.05 |e|² + 1e-10
        q <- clamp(q + clamp(J^T (J J^T + λ I)^-1 e, -1, 1), lower, upper)

    It stops below 1e-9 m and 1e-9 rad, or after 80 steps.

    Args:
        arm: native kinematics; its base frame defines the world.
        chain: joints of ``arm`` with their limits.
        T_link_tcp: (4, 4) pose of the tool on the last link [m].
        T_world_tcp: (N, 4, 4) target poses of the tool [m].
        starts: (N, J) configurations [rad or m]; values beyond a limit are clamped to it.

    Returns:
        Configurations (N, J), and the remaining errors (N, 2) of translation [m] and rotation [rad]. A configuration is
        a solution if both errors are at most ``CONSTANTS.max_error``.
    """
    tool = np.asarray(T_link_tcp, dtype=np.float64)
    q, error = _levenberg_marquardt(
        arm,
        np.ascontiguousarray(T_world_tcp[:, :3], dtype=np.float64),
        np.ascontiguousarray(tool[:3]),
        chain.lower,
        chain.upper,
        np.ascontiguousarray(np.clip(starts, chain.lower, chain.upper)),
        CONSTANTS.max_iterations,
    )
    return q, error


def nearest_turns(q: Array, near: Array, chain: KinematicChain) -> Array:
    """Turn revolute joints by full turns to the values nearest to ``near`` that are within the limits.

    The links stay where they are, but an arm whose joints turn further than once (most UR arms) moves less to them.

    Args:
        q: (..., J) configurations [rad or m] within the limits.
        near: (J,) posture [rad or m].
        chain: joints with their limits.
    """
    turn = 2 * np.pi
    wanted = np.round((near - q) / turn)
    turns = np.clip(wanted, np.ceil((chain.lower - q) / turn), np.floor((chain.upper - q) / turn))
    moved = np.clip(q + turn * turns, chain.lower, chain.upper)  # the sum may round to beyond a limit
    return np.asarray(np.where(chain.prismatic | (turns == 0.0), q, moved))


def is_rigid(T: Array) -> bool:
    """Return whether ``T`` is a finite (4, 4) pose with an orthonormal rotation."""
    return bool(
        T.shape == (4, 4) and np.isfinite(T).all() and np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() <= 1e-6
    )


def solve_ik(
    robot: ArmWithTool,
    T_base_tcp: ArrayLike,
    *,
    near: ArrayLike | None = None,
    seeds: int = 32,
    seed: int = 0,
    free: CollisionFilter | None = None,
    apart: float = 0.05,
    most: int = CONSTANTS.max_starts,
) -> IkSolutions:
    """Return the distinct configurations found that place the tool at ``T_base_tcp`` to ``CONSTANTS.max_error``.

    The starts are ``near``, the home posture and uniformly random configurations. While none of them gives a
    free solution, further random starts follow, up to ``most`` in total. With ``seeds=1`` only ``near`` is solved, so
    that a sequence of calls follows one branch of solutions. Equal arguments give equal solutions. Joints that can turn
    further than once take the turn nearest to ``near``.

    Args:
        robot: the arm.
        T_base_tcp: (4, 4) pose of the tool in the base frame [m].
        near: (J,) posture [rad or m]. If None, the home posture is used.
        seeds: number of starts, 1 or more.
        seed: seed of the random starts.
        free: filter that maps configurations (K, J) to (K,). If None, collisions are not checked.
        apart: distance in the largest joint difference [rad or m] below which two solutions count as one.
        most: largest number of starts.

    Raises:
        InputError: the pose is not rigid, or ``near`` does not fit the robot.
    """
    T = np.asarray(T_base_tcp, dtype=np.float64)
    if not is_rigid(T):
        raise InputError("is no rigid pose.", field="T_base_tcp", hint="give (4, 4) with an orthonormal rotation")
    chain = robot.chain
    posture = robot.configurations(robot.home if near is None else near)
    fixed = posture[None] if near is None else np.stack([posture, robot.home])
    rng = np.random.default_rng(seed)
    starts = np.concatenate([fixed, _random(chain, max(0, seeds - len(fixed)), rng)])[:seeds]
    q, tried = nearest_turns(_solutions(robot, T, starts), posture, chain), len(starts)
    kept = _distinct(q, posture, apart, free)
    while seeds > 1 and not len(kept) and tried < most:
        starts = _random(chain, min(seeds, most - tried), rng)
        more = nearest_turns(_solutions(robot, T, starts), posture, chain)
        q, tried = np.concatenate([q, more]), tried + len(starts)
        kept = _distinct(q, posture, apart, free)
    return IkSolutions(kept, tried, len(q))


def _distinct(q: Array, posture: Array, apart: float, free: CollisionFilter | None) -> Array:
    """Return the distinct free configurations (K, J) of ``q`` (N, J), sorted by distance from ``posture``."""
    distinct: list[Array] = []
    for candidate in q[np.argsort(np.linalg.norm(q - posture, axis=1), kind="stable")]:
        if all(np.abs(candidate - other).max() > apart for other in distinct):
            distinct.append(candidate)
    kept = np.array(distinct).reshape(-1, len(posture))
    return kept[free(kept)] if free is not None and len(kept) else kept


def _random(chain: KinematicChain, count: int, rng: np.random.Generator) -> Array:
    return rng.uniform(chain.lower, chain.upper, (count, len(chain)))


def _solutions(robot: ArmWithTool, T: Array, starts: Array) -> Array:
    """Return the configurations (K, J) of the starts (S, J) that converge."""
    targets = np.tile(T, (len(starts), 1, 1))
    q, error = inverse_kinematics(_kinematics(robot.chain), robot.chain, robot.T_link_tcp, targets, starts)
    return q[(error <= CONSTANTS.max_error).all(axis=1)]


@lru_cache(maxsize=16)
def _kinematics(chain: KinematicChain) -> Arm:
    """Return the native arm of a chain, without spheres and with its base at the origin."""
    return Arm(
        joints=np.ascontiguousarray(chain.T_before_joint[:, :3, :]),
        prismatic=chain.prismatic.astype(np.uint8),
        travel=np.maximum(np.abs(chain.lower), np.abs(chain.upper)),
        link=np.zeros(0, np.int32),
        centers=np.zeros((0, 3)),
        radii=np.zeros(0),
        pairs=np.zeros((0, 2), np.int32),
        base=np.ascontiguousarray(np.eye(4)[:3]),
        base_in_map=False,
    )
