"""Whether an arm gets there: postures at a grasp, and the straight way to it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.grasping.hands import OPENINGS
from splatbot.planning.cartesian import straight_line
from splatbot.planning.goals import goal_configurations
from splatbot.planning.problem import PlanStatus, PoseGoal
from splatbot.protocols import Array, HandShape, HasHand, RobotKinematics

_POSTURES = 4  # of a grasp whose approach is tried
ROOM = 0.03  # [m] of the arm beyond which more is no better


@dataclass(frozen=True, eq=False)
class Reached:
    """How an arm reaches a grasp, or why not.

    Args:
        q: (J,) at the grasp; None: it does not.
        path: (K, J) from the pre-grasp to the grasp.
        room: of the arm along it [m].
        limits: the least distance to a joint's limit, as a part of half its range, 0..1.
        why: it does not, in words; empty: it does.
        kind: of the reason, as results count them.
    """

    q: Array | None
    path: Array | None
    room: float
    limits: float
    why: str = ""
    kind: str = ""


class ReachabilityCheck(Protocol):
    """Who says whether a grasp can be reached."""

    def reach(self, T_world_tcp: Array, T_world_pregrasp: Array, opening: float) -> Reached:
        """Postures at the grasp and a straight way to it.

        Args:
            T_world_tcp: (4, 4) at the grasp.
            T_world_pregrasp: (4, 4) where the straight way begins.
            opening: of the fingers on it [m].
        """
        ...


def hand_of(robot: RobotKinematics) -> HandShape:
    """The robot's fingers.

    Raises:
        InputError: it has none.
    """
    hand = robot.hand if isinstance(robot, HasHand) else None
    if hand is None:
        raise InputError("has no fingers.", field=robot.name, hint="take a robot with a gripper, as panda")
    return hand


class ArmReach:
    """An arm among the Gaussians of a map: inverse kinematics, then a straight line that is certified.

    Args:
        robot: with a tool.
        T_world_base: (4, 4) where it stands.
        around: the map without the target, that the whole way is certified against.
        whole: the map with it, that the arm must be free of at the start of the way.
        margin: room to keep from the map [m].
        seed: of the postures.
    """

    def __init__(
        self,
        robot: RobotKinematics,
        T_world_base: Array,
        around: GaussianCollisionField,
        whole: GaussianCollisionField | None = None,
        *,
        margin: float = 0.0,
        seed: int = 0,
    ) -> None:
        if not 0.0 <= margin < np.inf:
            raise InputError(f"is {margin}.", field="margin", hint="give metres, 0 or more")
        self.robot, self.around, self.whole, self.seed = robot, around, whole, seed
        chain = robot.chain
        stroke = hand_of(robot).stroke
        self._near = (chain.lower + chain.upper) / 2

        @cache
        def arm(steps: int) -> RobotSpheres:
            width = min(steps * OPENINGS, stroke)
            return RobotSpheres(robot, T_world_base=T_world_base, opening=width, margin=margin)

        self._arm = arm

    def arm(self, opening: float) -> RobotSpheres:
        """The arm with its fingers opened at least so far [m]."""
        return self._arm(int(np.ceil(opening / OPENINGS - 1e-6)))

    def reach(self, T_world_tcp: Array, T_world_pregrasp: Array, opening: float) -> Reached:
        """See :class:`ReachabilityCheck`."""
        arm = self.arm(opening)
        goals = goal_configurations(
            arm,
            self.around,
            PoseGoal(T_world_tcp, postures=_POSTURES),
            near=self._near,
            seed=self.seed,
            until=time.perf_counter(),
        )
        if not len(goals.q):
            kind = "no posture reaches" if goals.status is PlanStatus.NO_IK_SOLUTION else "the arm is in the way of"
            return Reached(None, None, 0.0, 0.0, goals.reason.rstrip("."), kind)
        why, kind = "", ""
        for q in goals.q:
            back = straight_line(arm, self.around, q, T_world_pregrasp)
            if not back or back.path is None:
                why, kind = f"its approach is blocked: {back.reason.rstrip('.')}", "have a blocked approach"
                continue
            start = back.path.waypoints[-1]
            if self.whole is not None and arm.check(self.whole, start[None]).in_collision[0]:
                why, kind = "the arm touches the target before it approaches", "have a blocked approach"
                continue
            room = float(back.path.certificate.clearance)
            return Reached(q, back.path.waypoints[::-1].copy(), room, self._limits(q))
        return Reached(None, None, 0.0, 0.0, why, kind)

    def _limits(self, q: Array) -> float:
        chain = self.robot.chain
        half = (chain.upper - chain.lower) / 2
        return float((np.minimum(q - chain.lower, chain.upper - q) / half).min())
