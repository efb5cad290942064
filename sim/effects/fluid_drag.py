"""Air or water slows what moves through it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft

_VACUUM = 1e-300  # [kg/m³]: MuJoCo computes the forces, and they change no bit


class FluidDrag(PhysicsEffect):
    """MuJoCo's inertia-box drag on every body."""

    name = "fluid_drag"
    cost = "two forces for each body that moves"
    observable = "travelled"

    def called_for(self, scene: Scene) -> str:
        """The scene has a medium."""
        return f"the room is filled with {scene.medium.density:g} kg/m³" if scene.medium is not None else ""

    def not_called_for(self, scene: Scene) -> str:
        """It has none."""
        return "no medium is given"

    def build(self, draft: Draft) -> None:
        """The medium; if forced without one, a vacuum, in full."""
        medium, option = draft.scene.medium, draft.spec.option
        option.density = _VACUUM if medium is None else medium.density
        option.viscosity = 0.0 if medium is None else medium.viscosity
        option.wind = [0.0, 0.0, 0.0] if medium is None else list(medium.wind)


EFFECT = FluidDrag()
