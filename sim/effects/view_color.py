"""Colours of a map that change with the direction they are seen from; without it each Gaussian has one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatbot.sim.effects.physics import PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene
    from splatbot.sim.world import Draft


class ViewColor(PhysicsEffect):
    """Costs when images are drawn, not when physics is stepped; the camera's map evaluates degree 0 where it is off."""

    name = "view_color"
    cost = "spherical harmonics of each Gaussian in view, in each drawn image"
    observable = "harmonics"

    def called_for(self, scene: Scene) -> str:
        """A camera sees a map whose harmonics go beyond degree 0."""
        if scene.camera is not None and scene.map is not None and scene.map.harmonics:
            return f"a camera sees a map with colours of degree {scene.map.harmonics}"
        return ""

    def not_called_for(self, scene: Scene) -> str:
        """No map, nobody looks, or colours that do not change."""
        if scene.map is None:
            return "there is no map"
        if scene.camera is None:
            return "no camera looks"
        return "the map's colours are of degree 0"

    def build(self, draft: Draft) -> None:
        """Nothing of it is in the physics; see :class:`splatbot.sim.map_view.MapView`."""


EFFECT = ViewColor()
