"""Bodies that meet do not pass through each other; who may meet whom is in masks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect, names_of

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

FIXED, MOVABLE, ROBOT = 1, 2, 4  # bits: what does not give way, what does, the arm
MEETS = {FIXED: 0, MOVABLE: FIXED | MOVABLE, ROBOT: FIXED | MOVABLE | ROBOT}


class Contact(PhysicsEffect):
    """MuJoCo's collision detection and contact solver; fixed things are never tested against each other."""

    name = "contact"
    cost = "collision detection and a solver for what touches"
    observable = "contact_steps"

    def called_for(self, scene: Scene) -> str:
        """Something can move and meet something else."""
        if scene.movable or scene.soft:
            return f"{names_of((*scene.movable, *scene.soft))} can be pushed, and rest on something"
        if scene.robot is not None and (scene.objects or scene.map is not None):
            return "the arm moves among things"
        return ""

    def not_called_for(self, scene: Scene) -> str:
        """Nothing can meet."""
        return "there is nothing that could be touched"

    def build(self, draft: Draft) -> None:
        """Masks for every geom, and the flag that had kept contacts off."""
        draft.spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        for body in draft.robot_bodies:
            _mask(body.geoms, ROBOT)
        for thing in draft.scene.objects:
            if thing.name in draft.bodies:
                _mask(draft.bodies[thing.name].geoms, MOVABLE if thing.movable or thing.soft else FIXED)
        for flex in draft.spec.flexes:
            flex.contype, flex.conaffinity = MOVABLE, MEETS[MOVABLE] | ROBOT
        _mask(draft.map_geoms, FIXED)


def _mask(geoms: Any, kind: int) -> None:
    for geom in geoms:
        geom.contype, geom.conaffinity = kind, MEETS[kind]


EFFECT = Contact()
