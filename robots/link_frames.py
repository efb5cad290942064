"""Names and places of the frames that a robot's driver publishes for its links in TF."""

from __future__ import annotations

from dataclasses import dataclass

from splatbot.errors import InputError
from splatbot.protocols import Array


@dataclass(frozen=True, eq=False)
class LinkFrames:
    """Frames of a robot's links in TF.

    Args:
        names: (J + 1) names from the base outwards: the parent link of the first joint, then the child link of each
            joint.
        T_frame_link: (J + 1, 4, 4) poses of the model's links in these frames [m]. In the model each joint turns
            about z.

    Raises:
        InputError: there is not one pose for each name, or two names are the same.
    """

    names: tuple[str, ...]
    T_frame_link: Array

    def __post_init__(self) -> None:
        if self.T_frame_link.shape != (len(self.names), 4, 4):
            hint = f"give ({len(self.names)}, 4, 4)"
            raise InputError(f"is {self.T_frame_link.shape}.", field="T_frame_link", hint=hint)
        if len(set(self.names)) < len(self.names):
            raise InputError(f"repeats one of {', '.join(self.names)}.", field="names", hint="name each link once")

    def prefixed(self, prefix: str) -> LinkFrames:
        """Return the frames of a driver that puts a prefix before all names, as ``left_``."""
        return LinkFrames(tuple(prefix + name for name in self.names), self.T_frame_link)
