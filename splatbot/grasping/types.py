"""What grasping answers: ranked grasps with every term of their score, or why there is none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from splatbot.errors import SplatbotError
from splatbot.grasping.affordance import Target
from splatbot.protocols import Array


@dataclass(frozen=True, eq=False)
class Grasp:
    """A pose of the hand at which it takes hold, and what speaks for it.

    Args:
        T_world_tcp: (4, 4) of the tool: z is the approach, the fingers close along y.
        width: of the target between the fingers [m].
        opening: of the fingers as they come [m].
        contacts: (2, 3) where they touch [m, world].
        normals: (2, 3) of the surface there, outwards.
        approach: "top", "side", "front" (side, along the robot's own view) or "free".
        terms: each in 0..1, 1 is best; see :mod:`splatbot.grasping.score`.
        total: their weighted mean.
        room: the least distance of the hand to the target beside its pads, and to all else, on the way [m].
        T_world_pregrasp: (4, 4) from where it goes straight to the grasp.
        q: (J,) at the grasp; None: no arm was asked.
        q_pregrasp: (J,) at the start of the straight approach.
        approach_path: (K, J) from there to the grasp, certified free of all but the target.
        rejected: why it will not do; empty: it will.
    """

    T_world_tcp: Array
    width: float
    opening: float
    contacts: Array
    normals: Array
    approach: str
    terms: Mapping[str, float]
    total: float
    room: float
    T_world_pregrasp: Array
    q: Array | None = None
    q_pregrasp: Array | None = None
    approach_path: Array | None = field(default=None, repr=False)
    rejected: str = ""

    @property
    def clear(self) -> bool:
        """Whether hand and arm, at the grasp and on the straight way to it, keep clear of where something moved; True
        also where nothing did."""
        return self.terms.get("clear", 1.0) > 0.0


@dataclass(frozen=True, eq=False)
class GraspResult:
    """Grasps of a target.

    Args:
        target: what was asked for.
        grasps: best first; may be empty.
        rejected: how many candidates fell to what, in the order of the tests.
        best_rejected: of those that came farthest, the best.
        candidates: how many hands were scored.
        seconds: by stage.
        map_version: of the map that was asked.
    """

    target: Target
    grasps: tuple[Grasp, ...]
    rejected: Mapping[str, int]
    best_rejected: Grasp | None
    candidates: int
    seconds: Mapping[str, float]
    map_version: int
    notes: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.grasps)

    def unwrap(self) -> Grasp:
        """The best grasp.

        Raises:
            NoGraspError: there is none; it says why.
        """
        if self.grasps:
            return self.grasps[0]
        raise NoGraspError(self)


class NoGraspError(SplatbotError):
    """Nothing is left of the candidates; ``result`` tells what each fell to."""

    http_status = 422

    def __init__(self, result: GraspResult) -> None:
        self.result = result
        counts = ", ".join(f"{count} {reason}" for reason, count in result.rejected.items() if count)
        text = f"cannot be grasped: of {result.candidates} hands and their contacts {counts or 'none was found'}."
        if result.notes:
            text += " " + " ".join(result.notes)
        best = result.best_rejected
        if best is not None:
            at = ", ".join(f"{x:.3f}" for x in np.asarray(best.T_world_tcp)[:3, 3])
            text += f" The best of them, {best.approach} at ({at}), {1e3 * best.width:.0f} mm wide, {best.rejected}."
        super().__init__(text, field=result.target.label, hint="see the target from more sides, or take another hand")
