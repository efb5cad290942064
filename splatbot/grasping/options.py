"""Options of grasp sampling."""

from __future__ import annotations

from dataclasses import dataclass

from splatbot.errors import InputError

_RANGES = {
    "friction": (0.01, 2.0),
    "samples": (1, 100_000),
    "rolls": (1, 360),
    "depths": (1, 20),
    "pregrasp": (0.01, 0.5),
    "wanted": (1, 1000),
    "min_confidence": (0.0, 1.0),
}
APPROACHES = ("any", "top", "side")


@dataclass(frozen=True)
class GraspOptions:
    """Options of a search for antipodal grasps.

    Args:
        friction: Coulomb friction coefficient mu between pads and target.
        samples: number of seed points on the surface. More seeds take longer and cover more of it. If no grasp is
            found, the search is repeated once with four times as many seeds and sharper edges.
        rolls: number of approach directions around the closing axis of each contact pair.
        depths: number of distances from the finger tips at which the contacts are placed.
        pregrasp: shortest length of the straight approach from the pre-grasp to the grasp [m]. It is longer, up to
            0.3 m, where no plan may end at that pre-grasp.
        wanted: maximum number of grasps to return.
        approach: "any", "top" or "side".
        min_confidence: least confidence 0..1 of a grasp that is offered.
        accept_implied: offer grasps of which no contact is at measured depth, or whose finger enters unseen space.
            It has no effect without raw depth.
        seed: seed of the random generator.

    Raises:
        InputError: a value is out of range.
    """

    friction: float = 0.5
    samples: int = 400
    rolls: int = 12
    depths: int = 5
    pregrasp: float = 0.10
    wanted: int = 10
    approach: str = "any"
    min_confidence: float = 0.5
    accept_implied: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"is {getattr(self, name)}.", field=name, hint=f"give {low:g}..{high:g}")
        if self.approach not in APPROACHES:
            raise InputError(f"is {self.approach!r}.", field="approach", hint=f"one of {', '.join(APPROACHES)}")
