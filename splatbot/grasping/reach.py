"""Reachability of grasps: inverse kinematics at the grasp and a certified straight approach."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.planning.cartesian import StraightResult, along, straight_line
from splatbot.planning.goals import goal_configurations
from splatbot.planning.problem import PlanStatus, PoseGoal
from splatbot.protocols import ArmWithHand, Array, HandShape, HasHand, RobotKinematics


@dataclass(frozen=True)
class ReachConstants:
    """Constants of the reachability of grasps.

    Args:
        max_solutions: IK solutions of a grasp whose approach is tried.
        short_approach: [m] a short straight approach, the advice where an approach is free over this length.
        max_retreat: [m] longest straight approach from a pre-grasp that was moved back, since no plan may end nearer.
        full_score_clearance: [m] clearance of the arm with the score 1.
    """

    max_solutions: int = 4
    short_approach: float = 0.05
    max_retreat: float = 0.3
    full_score_clearance: float = 0.03


CONSTANTS = ReachConstants()
BLOCKED, TOUCHES = "its approach is blocked", "the arm touches the target before it approaches"
BLOCKED_NEAR, BLOCKED_FAR = "have a blocked approach near the grasp", "have a blocked approach"
"""Kinds of blocked approaches: within a short approach of the grasp, and farther away."""
_WITH_GRIPPER = "take a robot with a gripper, as panda or ur5e-2f85 (`splatbot robot list` has all)"


@dataclass(frozen=True, eq=False)
class Reached:
    """Result of a reachability check.

    Args:
        q: (J,) joint positions at the grasp. If None, the arm does not reach it.
        path: (K, J) path from the pre-grasp to the grasp.
        T_world_pregrasp: (4, 4) pose of the tool at its start; farther back than requested where no plan may end there.
        blocked: the way back from the grasp, if an obstacle ends it.
        clearance: minimum clearance of the arm along the path [m].
        limits: minimum distance to a joint limit as a fraction of half the joint's range, 0..1.
        reason: reason for which the grasp is not reachable; empty if it is.
        kind: category of the reason, under which results count it.
    """

    q: Array | None
    path: Array | None
    clearance: float
    limits: float
    reason: str = ""
    kind: str = ""
    T_world_pregrasp: Array | None = None
    blocked: StraightResult | None = None


@dataclass(frozen=True, eq=False)
class LinkGuard:
    """Obstacles from which the links before the hand keep more distance than the hand does.

    Args:
        links: the links, with the margin that they keep.
        field: the obstacles.
        obstacle: their name.
        kind: category of the reason if a path is nearer; see :class:`Reached`.
    """

    links: RobotSpheres
    field: GaussianCollisionField
    obstacle: str
    kind: str

    def meets(self, path: Array) -> bool:
        """Return whether a link comes within the margin of an obstacle on a path (K, J)."""
        return bool(self.links.certify(self.field, path[:-1], path[1:]).in_collision.any())

    @property
    def reason(self) -> str:
        """Describe a path on which a link comes too near, as a clause."""
        return f"the arm comes within {1e3 * self.links.margin:.1f} mm of {self.obstacle} on its approach"


def link_guards(
    robot: RobotKinematics,
    T_world_base: Array,
    around: GaussianCollisionField,
    *,
    margin: float,
    arm_margin: float,
    unknown: GaussianCollisionField | None,
) -> tuple[LinkGuard, ...]:
    """Return the guards of the links before the hand on the way to a grasp; for arguments see :class:`ArmReach`."""
    most = max(margin, arm_margin)
    links = RobotSpheres(robot, T_world_base=T_world_base, margin=most).without_hand(most)
    found = []
    if arm_margin > margin:
        found.append(LinkGuard(links, around, "the map", "bring the arm within the margin of the map"))
    if unknown is not None:
        found.append(LinkGuard(links, unknown, "unknown space", "bring the arm into unknown space"))
    return tuple(found)


class ReachabilityCheck(Protocol):
    """Checks whether an arm reaches a grasp."""

    def reach(self, T_world_tcp: Array, T_world_pregrasp: Array, opening: float, width: float) -> Reached:
        """Find joint positions at the grasp and a straight approach to it.

        Args:
            T_world_tcp: (4, 4) pose of the tool at the grasp.
            T_world_pregrasp: (4, 4) pose of the tool at the start of the shortest approach.
            opening: finger opening during the approach [m].
            width: finger opening at the closed grasp [m].
        """
        ...


def with_hand(robot: RobotKinematics) -> tuple[ArmWithHand, HandShape]:
    """Return a robot as an arm with a hand, and the shape of the hand.

    Raises:
        InputError: the robot has no fingers.
    """
    if not isinstance(robot, HasHand) or robot.hand is None:
        raise InputError(
            "has no fingers.",
            field=robot.name,
            hint="take a robot with a gripper, as panda or ur5e-2f85 (`splatbot robot list` has all)",
        )
    return robot, robot.hand


class ArmReach:
    """Checks reachability against the Gaussians of a map: inverse kinematics, then a certified straight line.

    Args:
        robot: arm with a tool.
        T_world_base: (4, 4) pose of its base.
        around: field of the map without the target; the whole approach is certified against it.
        whole: field of the whole map, of which the arm must be free at the pre-grasp. If None, this is not checked.
        around_held: field that the closed fingers avoid, ``around`` without strays inside of the target. If None, it is
            ``around``.
        margin: clearance that arm and hand keep from the map [m].
        arm_margin: the same for the links before the hand alone [m].
        departure: field of the plan to the pre-grasp. There the robot, with its hand fully open, keeps both margins
            from it. If None, this is not checked.
        unknown: field of unknown space. The links before the hand keep both margins from it on the whole approach.
        seed: seed of inverse kinematics.
    """

    def __init__(
        self,
        robot: RobotKinematics,
        T_world_base: Array,
        around: GaussianCollisionField,
        whole: GaussianCollisionField | None = None,
        *,
        around_held: GaussianCollisionField | None = None,
        margin: float = 0.0,
        arm_margin: float = 0.0,
        departure: GaussianCollisionField | None = None,
        unknown: GaussianCollisionField | None = None,
        seed: int = 0,
    ) -> None:
        for name, value in (("margin", margin), ("arm_margin", arm_margin)):
            if not 0.0 <= value < np.inf:
                raise InputError(f"is {value}.", field=name, hint="give metres, 0 or more")
        self.robot, hand = with_hand(robot)
        self.around, self.whole, self.seed = around, whole, seed
        self.around_held = around if around_held is None else around_held
        self.departure = departure

        @cache
        def arm(steps: int) -> RobotSpheres:
            width = min(steps * HANDS.opening_step, hand.stroke)
            return RobotSpheres(robot, T_world_base=T_world_base, opening=width, margin=margin)

        self._arm = arm
        self._open = RobotSpheres(robot, T_world_base=T_world_base, margin=max(margin, arm_margin))
        self._guards = link_guards(robot, T_world_base, around, margin=margin, arm_margin=arm_margin, unknown=unknown)

    def arm(self, opening: float) -> RobotSpheres:
        """Return the arm's spheres with the fingers opened to ``opening`` [m], rounded up to 2 mm."""
        return self._arm(int(np.ceil(opening / HANDS.opening_step - 1e-6)))

    def reach(self, T_world_tcp: Array, T_world_pregrasp: Array, opening: float, width: float) -> Reached:
        """Check a grasp; see :class:`ReachabilityCheck`."""
        arm = self.arm(opening)
        goals = goal_configurations(
            arm,
            self.around,
            PoseGoal(T_world_tcp, postures=CONSTANTS.max_solutions),
            near=self.robot.home,
            seed=self.seed,
            until=time.perf_counter(),
        )
        if not len(goals.q):
            kind = "no posture reaches" if goals.status is PlanStatus.NO_IK_SOLUTION else "the arm is in the way of"
            return Reached(None, None, 0.0, 0.0, goals.reason.rstrip("."), kind)
        closed = RobotSpheres(self.robot, T_world_base=self._open.T_world_base, opening=width, margin=arm.margin)
        reason, kind, blocked = "", "", None
        length = float(np.linalg.norm(T_world_tcp[:3, 3] - T_world_pregrasp[:3, 3]))
        for q in goals.q:
            blocked = None
            back = straight_line(arm, self.around, q, T_world_pregrasp)
            if not back or back.path is None:
                near = back.share * length < CONSTANTS.short_approach
                reason, kind = f"{BLOCKED}: {back.reason.rstrip('.')}", BLOCKED_NEAR if near else BLOCKED_FAR
                blocked = back
                continue
            away, clearance, T_start = back.path.waypoints, back.path.certificate.clearance, T_world_pregrasp
            if self.whole is not None and arm.check(self.whole, away[-1:]).in_collision[0]:
                reason, kind = TOUCHES, "touch the target before they approach"
                continue
            if not self._plan_may_end(away[-1:])[0]:
                farther = straight_line(arm, self.around, away[-1], self._farthest(T_world_tcp, T_world_pregrasp))
                beyond = away[:0] if farther.path is None else farther.path.waypoints[1:]
                ends = np.flatnonzero(self._plan_may_end(beyond))
                if farther.path is None or not len(ends):
                    reason, kind = "no plan may end at its pre-grasp", "start where no plan may end"
                    continue
                away = np.concatenate([away, beyond[: ends[0] + 1]])
                clearance = min(clearance, farther.path.certificate.clearance)
                link = arm.forward(away[[0, -1]])[:, -1, :3, 3]  # without rotation, the tool moves as its link does
                T_start = along(T_world_tcp, -float(np.linalg.norm(link[1] - link[0])))
            if closed.check(self.around_held, q[None]).in_collision[0]:
                reason, kind = "the closed fingers touch its surroundings", "close in the surroundings"
                continue
            met = next((guard for guard in self._guards if guard.meets(away)), None)
            if met is not None:
                reason, kind = met.reason, met.kind
                continue
            return Reached(q, away[::-1].copy(), float(clearance), self._limits(q), T_world_pregrasp=T_start)
        return Reached(None, None, 0.0, 0.0, reason, kind, blocked=blocked)

    def _plan_may_end(self, q: Array) -> NDArray[np.bool_]:
        """Return whether a plan may end at each configuration (K, J): the open hand keeps the margins there."""
        if self.departure is None or not len(q):
            return np.ones(len(q), dtype=bool)
        return ~self._open.check(self.departure, q).in_collision

    @staticmethod
    def _farthest(T_world_tcp: Array, T_world_pregrasp: Array) -> Array:
        """Return the tool's pose at the start of the longest approach."""
        least = float(np.linalg.norm(T_world_tcp[:3, 3] - T_world_pregrasp[:3, 3]))
        return along(T_world_tcp, -max(CONSTANTS.max_retreat, least))

    def _limits(self, q: Array) -> float:
        chain = self.robot.chain
        half = (chain.upper - chain.lower) / 2
        return float((np.minimum(q - chain.lower, chain.upper - q) / half).min())
