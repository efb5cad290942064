"""Surfaces that touch resist sliding; without it everything is ice."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect, names_of

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

_FINGERS = ("finger1", "finger2")


class Friction(PhysicsEffect):
    """Three rows a contact instead of one; four where fingers hold, so that they also resist turning."""

    name = "friction"
    cost = "three to four rows in the solver for each contact instead of one"
    observable = "tangential_n"

    def called_for(self, scene: Scene) -> str:
        """Something movable touches, or the task rubs."""
        if scene.movable or scene.soft:
            return f"what holds and stops {names_of((*scene.movable, *scene.soft))} is friction"
        if scene.task.kind == "wipe":
            return "the tool rubs on a surface"
        return ""

    def not_called_for(self, scene: Scene) -> str:
        """Nothing slides."""
        return "nothing movable touches anything"

    def build(self, draft: Draft) -> None:
        """Friction for every geom; the coefficients are the objects' own."""
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
