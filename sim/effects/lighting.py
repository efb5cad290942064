"""Lamps, with shadows, that may be dimmed; without it a headlight at the camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from splatbot.sim.effects.physics import Hook, PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Light, Scene
    from splatbot.sim.world import Draft


class Dimmer(Hook):
    """Sets each lamp's brightness; MuJoCo reads it when it draws."""

    def __init__(self, model: Any, lights: tuple[Light, ...]) -> None:
        self._model = model
        self._changes = [(i, light) for i, light in enumerate(lights) if light.changes]

    def on_step(self, data: Any, time: float) -> None:
        """The latest change counts."""
        for i, light in self._changes:
            value = light.brightness
            for change in light.changes:
                value = change.brightness if change.t <= time else value
            self._model.light_diffuse[i] = value


class Lighting(PhysicsEffect):
    """Costs when images are drawn, not when physics is stepped."""

    name = "lighting"
    cost = "a pass for shadows in each drawn image"
    observable = "light"

    def called_for(self, scene: Scene) -> str:
        """A camera looks, and lamps are given."""
        if scene.lights and scene.camera is not None:
            return f"a camera sees {len(scene.lights)} lamps"
        return ""

    def not_called_for(self, scene: Scene) -> str:
        """No lamp, or nobody looks."""
        return "no camera looks" if scene.camera is None else "no lamp is given"

    def build(self, draft: Draft) -> None:
        """The lamps look down at the origin, and the headlight goes."""
        if not draft.scene.lights:
            return
        draft.spec.visual.headlight.diffuse = [0.15] * 3
        for light in draft.scene.lights:
            down = -np.array(light.at) / max(float(np.linalg.norm(light.at)), 1e-9)
            lamp = draft.spec.worldbody.add_light(pos=list(light.at), dir=down.tolist())
            lamp.diffuse, lamp.castshadow = [light.brightness] * 3, True

    def hook(self, model: Any, scene: Scene) -> Hook | None:
        """A dimmer where something changes."""
        return Dimmer(model, scene.lights)


EFFECT = Lighting()
