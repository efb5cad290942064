"""Friction between bodies in contact; without it they slide freely."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect, names_of

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

_FINGERS = ("finger1", "finger2")


class Friction(
    PhysicsEffect, cost="three to four solver rows for each contact instead of one", observable="tangential_n"
):
    """Coulomb friction: contacts of ``condim`` 3 instead of 1, and 4 at the fingers, which adds torsional friction.

    The coefficients are those of the objects in the scene.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether an object can move or the task rubs on a surface, and why."""
        if scene.movable or scene.soft:
            return True, f"friction holds and stops {names_of((*scene.movable, *scene.soft))}"
        if scene.task.kind == "wipe":
            return True, "the tool rubs on a surface"
        return False, "no movable object is in contact"

    def build(self, draft: Draft) -> None:
        """Set ``condim`` of every geom; the coefficients are those of the objects."""
        for body in draft.robot_bodies:
            for geom in body.geoms:
                geom.condim = 4 if body.name in _FINGERS else 3
        for body in draft.bodies.values():
            for geom in body.geoms:
                geom.condim = 3
        for flex in draft.spec.flexes:
            flex.condim = 3
        for geom in draft.map_geoms:
            geom.condim = 3


EFFECT = Friction()
