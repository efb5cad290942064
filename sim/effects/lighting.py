"""Lamps with shadows and changing brightness; without the effect a headlight at the camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from splatbot.sim.effects.physics import Hook, PhysicsEffect

if TYPE_CHECKING:
    from splatbot.sim.scene import Light, Scene
    from splatbot.sim.world import Draft


class Dimmer(Hook):
    """Sets the brightness of each lamp; MuJoCo reads it when it renders."""

    def __init__(self, model: Any, lights: tuple[Light, ...]) -> None:
        self._model = model
        self._changes = [(i, light) for i, light in enumerate(lights) if light.changes]

    def on_step(self, data: Any, time: float) -> None:
        """Apply the latest change of each lamp up to ``time`` [s]."""
        for i, light in self._changes:
            value = light.brightness
            for change in light.changes:
                value = change.brightness if change.t <= time else value
            self._model.light_diffuse[i] = value


class Lighting(PhysicsEffect, cost="a shadow pass for each rendered image", observable="light"):
    """MuJoCo lights with shadows at the positions [m] and brightnesses (0..1) of the scene's ``lights``.

    It costs rendering time, not physics time.
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether the scene has a camera and lamps, and why."""
        if scene.camera is None:
            return False, "there is no camera"
        if not scene.lights:
            return False, "no lamp is given"
        return True, f"a camera sees {len(scene.lights)} lamps"

    def build(self, draft: Draft) -> None:
        """Add the lamps, directed at the origin, and dim the headlight."""
        if not draft.scene.lights:
            return
        draft.spec.visual.headlight.diffuse = [0.15] * 3
        for light in draft.scene.lights:
            down = -np.array(light.at) / max(float(np.linalg.norm(light.at)), 1e-9)
            lamp = draft.spec.worldbody.add_light(pos=list(light.at), dir=down.tolist())
            lamp.diffuse, lamp.castshadow = [light.brightness] * 3, True

    def hook(self, model: Any, scene: Scene) -> Hook | None:
        """Create a hook that changes the brightness of lamps."""
        return Dimmer(model, scene.lights)


EFFECT = Lighting()
