"""Deformable bodies as MuJoCo flexes; without the effect they are rigid boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from splatbot.sim.effects.physics import PhysicsEffect, names_of
from splatbot.sim.solids import SoftGeom, quat_of

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene, SceneObject
    from splatbot.sim.world import Draft


class SoftBodies(
    PhysicsEffect,
    cost="elastic forces and degrees of freedom for each grid corner of each body",
    observable="deformation",
):
    """Linear elastic finite elements on a grid (MuJoCo flex, trilinear) in place of a rigid box.

    Young's modulus [Pa], Poisson ratio, density [kg/m³] and grid cells are those of the scene's soft shape.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether the scene has soft objects, and why."""
        if not scene.soft:
            return False, "everything is rigid"
        return True, f"{names_of(scene.soft)} deform"

    def build(self, draft: Draft) -> None:
        """Replace the rigid boxes by flexes, with an integrator that is stable for stiff springs."""
        if draft.scene.soft:
            kinds = mujoco.mjtIntegrator
            draft.spec.option.integrator = getattr(kinds, "mjINT_DISCRETE", kinds.mjINT_IMPLICITFAST)
        for obj in draft.scene.soft:
            draft.spec.delete(draft.bodies.pop(obj.name))
            _attach(draft, obj)


def _attach(draft: Draft, obj: SceneObject) -> None:
    shape = obj.shapes[0]
    assert isinstance(shape, SoftGeom)
    size, cells = np.array(shape.size), np.array(shape.cells)
    radius = float(0.1 * (size / (cells - 1)).min())
    spacing = (size - 2 * radius) / (cells - 1)
    mass = float(size.prod() * shape.density)
    grid = f'type="grid" dim="3" dof="trilinear" count="{_text(cells)}" spacing="{_text(spacing)}"'
    text = f"""<mujoco><worldbody><body name="{obj.name}">
      <flexcomp name="{obj.name}" {grid} mass="{mass:.9g}" radius="{radius:.9g}" rgba="{_text(obj.color)} 1">
        <contact selfcollide="none" friction="{obj.friction:.9g} 0.005 0.0001"/>
        <elasticity young="{shape.young:.9g}" poisson="{shape.poisson:.9g}" damping="0.002"/>
      </flexcomp></body></worldbody></mujoco>"""
    frame = draft.spec.worldbody.add_frame(pos=list(obj.at), quat=quat_of(obj.rpy))
    draft.spec.attach(mujoco.MjSpec.from_string(text), frame=frame, prefix="object/")


def _text(values: object) -> str:
    return " ".join(f"{float(v):.9g}" for v in np.asarray(values))


EFFECT = SoftBodies()
