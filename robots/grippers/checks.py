"""Checks of gripper commands."""

from __future__ import annotations

from splatbot.errors import InputError


def check_move(stroke: float, opening: float, force: float | None, speed: float | None) -> None:
    """Check the values of a move.

    Raises:
        InputError: the opening is out of 0..stroke [m], or force [N] or speed [m/s] are not above 0.
    """
    if not 0.0 <= opening <= stroke:
        raise InputError(f"is {opening}.", field="opening", hint=f"give 0..{stroke:g} m")
    for name, value, unit in (("force", force, "newtons"), ("speed", speed, "metres a second")):
        if value is not None and not value > 0.0:
            raise InputError(f"is {value}.", field=name, hint=f"give {unit} above 0")
