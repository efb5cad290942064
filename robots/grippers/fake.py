"""A gripper that opens and closes instantly, optionally around an object of a given width."""

from __future__ import annotations

from splatbot.errors import InputError
from splatbot.robots.grippers.checks import check_move


class FakeGripper:
    """A :class:`splatbot.protocols.Gripper`.

    Args:
        stroke: widest opening [m].
        width: width of the object between the fingers [m]; 0 for no object.

    Raises:
        InputError: the width does not fit between the fingers.
    """

    def __init__(self, stroke: float = 0.08, *, width: float = 0.0) -> None:
        if not 0.0 <= width <= stroke:
            raise InputError(f"is {width}.", field="width", hint=f"give 0..{stroke:g} m")
        self.stroke, self.width = stroke, width
        self._opening = self._target = stroke

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        """Move to an opening [m], or to contact with the object; see :class:`splatbot.protocols.Gripper`."""
        check_move(self.stroke, opening, force, speed)
        self._target = opening
        self._opening = max(opening, self.width)

    def moving(self) -> bool:
        """Return False, because motions are instantaneous."""
        return False

    def opening(self) -> float:
        """Return the distance between the fingers [m]."""
        return self._opening

    def holds(self) -> bool:
        """Return whether the object stops the fingers."""
        return self._opening > self._target

    def stop(self) -> None:
        """Keep the present opening."""
        self._target = self._opening
