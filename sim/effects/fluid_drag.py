"""Drag of air or water on moving bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

_VACUUM = 1e-300  # [kg/m³]: MuJoCo computes the forces, and they change no bit of the state


class FluidDrag(PhysicsEffect, cost="two forces for each moving body", observable="travelled"):
    """Drag and viscous resistance by MuJoCo's inertia-box fluid model on every body.

    Density [kg/m³], viscosity [Pa s] and wind [m/s] are those of ``medium`` in the scene.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether the scene has a medium, and why."""
        if scene.medium is None:
            return False, "no medium is given"
        return True, f"the scene is filled with {scene.medium.density:g} kg/m³"

    def build(self, draft: Draft) -> None:
        """Set the medium; if it is forced without one, compute the forces of a vacuum."""
        medium, option = draft.scene.medium, draft.spec.option
        option.density = _VACUUM if medium is None else medium.density
        option.viscosity = 0.0 if medium is None else medium.viscosity
        option.wind = [0.0, 0.0, 0.0] if medium is None else list(medium.wind)


EFFECT = FluidDrag()
