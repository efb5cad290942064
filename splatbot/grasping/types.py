"""Results of grasp sampling: ranked grasps with all score terms, or the reasons for which candidates were rejected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from splatbot.errors import SplatbotError
from splatbot.grasping.affordance import Target
from splatbot.grasping.measured import CONSTANTS, blind
from splatbot.grasping.score import confidence
from splatbot.protocols import Array

FITTING = "hands: "
"""Prefix of the reasons for which hands that fit the target are rejected by the arm or by all measured depth."""


@dataclass(frozen=True, eq=False)
class Grasp:
    """A grasp of a parallel-jaw gripper with its score.

    Args:
        T_world_tcp: (4, 4) pose of the tool; z is the approach direction, the fingers close along y.
        width: distance of the pads when they touch the object [m]. It is that of the contacts, or wider where measured
            depth stands out under a pad.
        opening: finger opening during the approach [m].
        contacts: (2, 3) contact points [m, world].
        normals: (2, 3) outward surface normals at the contacts [world].
        approach: "top", "side", "front" (a side approach that points away from the robot base) or "free".
        terms: score terms, each in 0..1 with 1 the best; see :mod:`splatbot.grasping.score`.
        total: weighted mean of the terms.
        clearance: minimum clearance of the hand along the straight approach [m]. Contacts under the pads do not count.
        T_world_pregrasp: (4, 4) pose of the tool at the start of the straight approach.
        q: (J,) joint positions at the grasp. If None, reachability by an arm was not checked.
        q_pregrasp: (J,) joint positions at the pre-grasp.
        approach_path: (K, J) straight path from the pre-grasp to the grasp. It is certified against the map without
            the target.
        rejected: reason for which the grasp is rejected; empty for an accepted grasp.
        depth_distance: (2,) distance of each contact from the nearest confirmed point of raw depth [m], inf without
            such points near the target. If None, it was not checked.
        unseen: (2,) share of the inner face of each contact's finger that no frame saw to be free, 0..1. If None, it
            was not checked.
        lift_blocked: reason for which the straight lift of a pick is not certified; empty if it is, or was not checked.
    """

    T_world_tcp: Array
    width: float
    opening: float
    contacts: Array
    normals: Array
    approach: str
    terms: Mapping[str, float]
    total: float
    clearance: float
    T_world_pregrasp: Array
    q: Array | None = None
    q_pregrasp: Array | None = None
    approach_path: Array | None = field(default=None, repr=False)
    rejected: str = ""
    depth_distance: Array | None = None
    unseen: Array | None = None
    lift_blocked: str = ""

    @property
    def confidence(self) -> float:
        """Return the probability of success 0..1; see :func:`splatbot.grasping.score.confidence`."""
        return confidence(self.total)

    @property
    def implied(self) -> tuple[bool, ...]:
        """Return for each contact whether no measured depth supports it; empty if that was not checked."""
        if self.depth_distance is None:
            return ()
        return tuple(bool(away > CONSTANTS.contact_distance) for away in self.depth_distance)

    @property
    def blind(self) -> tuple[bool, ...]:
        """Return for each contact whether its finger enters unseen space, in which the object may continue.

        A contact within 6 mm of measured depth is where it is expected. The result is empty if that was not checked.
        """
        if self.depth_distance is None or self.unseen is None:
            return ()
        return tuple(bool(b) for b in blind(self.depth_distance, self.unseen))

    @property
    def approach_length(self) -> float:
        """Return the length of the straight approach from the pre-grasp to the grasp [m]."""
        return float(np.linalg.norm(self.T_world_tcp[:3, 3] - self.T_world_pregrasp[:3, 3]))

    @property
    def avoids_moving(self) -> bool:
        """Return whether hand and arm avoid the regions where motion was observed, at the grasp and on its approach.

        The value is True if no motion was observed.
        """
        return self.terms.get("clear", 1.0) > 0.0


@dataclass(frozen=True, eq=False)
class GraspResult:
    """Ranked grasps of one target.

    Args:
        target: the requested target.
        grasps: accepted grasps, best first; may be empty.
        rejected: number of rejected candidates for each reason, in the order of the tests.
        best_rejected: the best of the candidates that passed the most tests. If None, a grasp was accepted or no
            candidate exists.
        candidates: number of hand poses that were evaluated.
        seconds: duration of each stage [s].
        map_version: version of the map that was searched.
        notes: remarks on the result, each a sentence.
        doubtful: grasps that passed all tests, best first, but should not be executed. Their confidence is too small,
            or no contact is at measured depth, so that nothing measured shows an object between the fingers.
        first_rank: rank of the first of ``grasps``, from 0; larger where they are a part of a file.
    """

    target: Target
    grasps: tuple[Grasp, ...]
    rejected: Mapping[str, int]
    best_rejected: Grasp | None
    candidates: int
    seconds: Mapping[str, float]
    map_version: int
    notes: tuple[str, ...] = ()
    doubtful: tuple[Grasp, ...] = ()
    first_rank: int = 0

    def __bool__(self) -> bool:
        return bool(self.grasps)

    def unwrap(self) -> Grasp:
        """Return the best grasp.

        Raises:
            NoGraspError: no candidate was accepted; the message states the reasons.
        """
        if self.grasps:
            return self.grasps[0]
        raise NoGraspError(self)


class NoGraspError(SplatbotError):
    """All candidates were rejected; ``result`` holds the number of candidates for each reason."""

    http_status = 422

    def __init__(self, result: GraspResult) -> None:
        self.result = result
        counts = ", ".join(f"{count} {reason}" for reason, count in result.rejected.items() if count)
        text = f"cannot be grasped: of {result.candidates} hands and their contacts {counts or 'none was found'}."
        if result.doubtful:
            text = f"has no grasp that should be executed; {len(result.doubtful)} fit the map."
        if result.notes:
            text += " " + " ".join(result.notes)
        best = result.doubtful[0] if result.doubtful else result.best_rejected
        if best is not None:
            at = ", ".join(f"{x:.3f}" for x in np.asarray(best.T_world_tcp)[:3, 3])
            text += f" The best of them, {best.approach} at ({at}), {1e3 * best.width:.0f} mm wide, {best.rejected}."
        super().__init__(text, field=result.target.label, hint="see the target from more sides, or take another hand")
