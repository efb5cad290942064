"""How grasps are looked for."""

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
}
APPROACHES = ("any", "top", "side")


@dataclass(frozen=True)
class GraspOptions:
    """What a search for grasps may spend and return.

    Args:
        friction: coefficient between pads and target.
        samples: seeds on the surface: the knob of time against how much of it is tried; where that finds nothing,
            four times as many are tried once, with sharper rims.
        rolls: sides around each pair of contacts that the hand comes from.
        depths: how deep between the fingers the contacts may be.
        pregrasp: length of the straight approach [m].
        wanted: how many grasps to return.
        approach: "any", or only from the "top" or the "side".
        seed: of all that is drawn.

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
    seed: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"is {getattr(self, name)}.", field=name, hint=f"give {low:g}..{high:g}")
        if self.approach not in APPROACHES:
            raise InputError(f"is {self.approach!r}.", field="approach", hint=f"one of {', '.join(APPROACHES)}")
