"""Contact between bodies, with bit masks for the pairs that can collide."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco

from splatbot.sim.effects.physics import PhysicsEffect, names_of

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

FIXED, MOVABLE, ROBOT = 1, 2, 4  # bits of ``contype`` and ``conaffinity``
COLLIDES_WITH = {FIXED: 0, MOVABLE: FIXED | MOVABLE, ROBOT: FIXED | MOVABLE | ROBOT}


class Contact(PhysicsEffect, cost="collision detection, and a solver for the contacts", observable="contact_steps"):
    """MuJoCo's collision detection and contact solver; two fixed bodies are never tested against each other.

    Geoms collide if ``contype & conaffinity`` of the pair is not zero. Without the effect bodies pass through each
    other. Contact softness is MuJoCo's default ``solref`` and ``solimp``.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether two bodies can collide, and why."""
        if scene.movable or scene.soft:
            return True, f"{names_of((*scene.movable, *scene.soft))} can be pushed, and rest on something"
        if scene.robot is not None and (scene.objects or scene.map is not None):
            return True, "the arm moves among objects"
        return False, "no two bodies can collide"

    def build(self, draft: Draft) -> None:
        """Set the masks of every geom and enable contacts."""
        draft.spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        for body in draft.robot_bodies:
            _mask(body.geoms, ROBOT)
        for obj in draft.scene.objects:
            if obj.name in draft.bodies:
                _mask(draft.bodies[obj.name].geoms, MOVABLE if obj.movable or obj.soft else FIXED)
        for flex in draft.spec.flexes:
            flex.contype, flex.conaffinity = MOVABLE, COLLIDES_WITH[MOVABLE] | ROBOT
        _mask(draft.map_geoms, FIXED)


def _mask(geoms: Any, kind: int) -> None:
    for geom in geoms:
        geom.contype, geom.conaffinity = kind, COLLIDES_WITH[kind]


EFFECT = Contact()
