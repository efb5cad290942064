"""View-dependent colours of a map; without the effect each Gaussian has one colour."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft


class ViewColor(
    PhysicsEffect, cost="spherical harmonics of each visible Gaussian, in each rendered image", observable="harmonics"
):
    """Spherical harmonics of the Gaussians up to the map's degree (Kerbl et al. 2023); degree 0 without the effect.

    It costs rendering time, not physics time.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether the scene has a camera and a map with harmonics beyond degree 0, and why."""
        if scene.map is None:
            return False, "there is no map"
        if scene.camera is None:
            return False, "there is no camera"
        if not scene.map.harmonics:
            return False, "the map's colours are of degree 0"
        return True, f"a camera sees a map with colours of degree {scene.map.harmonics}"

    def build(self, draft: Draft) -> None:
        """Leave the physics unchanged; see :class:`splatbot.sim.map_view.MapView` for the rendering."""


EFFECT = ViewColor()
