"""Bodies that deform, by MuJoCo's flexes; without it they are rigid boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from splatbot.sim.effects.physics import PhysicsEffect, names_of
from splatbot.sim.solids import SoftGeom, quat_of

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene, SceneObject
    from splatbot.sim.world import Draft


class SoftBodies(PhysicsEffect):
    """Finite elements of a grid in place of a rigid box."""

    name = "soft_bodies"
    cost = "elastic forces and degrees of freedom for each corner of each body"
    observable = "deformation"

    def called_for(self, scene: Scene) -> str:
        """There is something soft."""
        return f"{names_of(scene.soft)} deform" if scene.soft else ""

    def not_called_for(self, scene: Scene) -> str:
        """Nothing is."""
        return "everything is rigid"

    def build(self, draft: Draft) -> None:
        """The rigid stand-ins make way; stiff springs call for an integrator that knows them."""
        if draft.scene.soft:
            kinds = mujoco.mjtIntegrator
            draft.spec.option.integrator = getattr(kinds, "mjINT_DISCRETE", kinds.mjINT_IMPLICITFAST)
        for thing in draft.scene.soft:
            draft.spec.delete(draft.bodies.pop(thing.name))
            _attach(draft, thing)


def _attach(draft: Draft, thing: SceneObject) -> None:
    shape = thing.shapes[0]
    assert isinstance(shape, SoftGeom)
    size, cells = np.array(shape.size), np.array(shape.cells)
    radius = float(0.1 * (size / (cells - 1)).min())
    spacing = (size - 2 * radius) / (cells - 1)
    mass = float(size.prod() * shape.density)
    grid = f'type="grid" dim="3" dof="trilinear" count="{_text(cells)}" spacing="{_text(spacing)}"'
    text = f"""<mujoco><worldbody><body name="{thing.name}">
      <flexcomp name="{thing.name}" {grid} mass="{mass:.9g}" radius="{radius:.9g}" rgba="{_text(thing.color)} 1">
        <contact selfcollide="none" friction="{thing.friction:.9g} 0.005 0.0001"/>
        <elasticity young="{shape.young:.9g}" poisson="{shape.poisson:.9g}" damping="0.002"/>
      </flexcomp></body></worldbody></mujoco>"""
    frame = draft.spec.worldbody.add_frame(pos=list(thing.at), quat=quat_of(thing.rpy))
    draft.spec.attach(mujoco.MjSpec.from_string(text), frame=frame, prefix="object/")


def _text(values: object) -> str:
    return " ".join(f"{float(v):.9g}" for v in np.asarray(values))


EFFECT = SoftBodies()
