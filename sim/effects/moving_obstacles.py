"""Obstacles that are carried along a path, whatever stands in their way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from splatbot.protocols import Array
from splatbot.sim.effects.physics import Hook, PhysicsEffect, names_of

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene, SceneObject
    from splatbot.sim.world import Draft


def place_on(thing: SceneObject, time: float) -> Array:
    """Where (3,) [m] an object is on its path at a time [s]: linear between places, there and back again."""
    times, places = np.array([p.t for p in thing.path]), np.array([p.at for p in thing.path])
    length = times[-1]
    t = time % (2 * length)
    t = t if t <= length else 2 * length - t
    return np.array([np.interp(t, times, column) for column in places.T])


class Carried(Hook):
    """Puts each obstacle where its path says, there and back again."""

    def __init__(self, paths: list[tuple[int, SceneObject]]) -> None:
        self._paths = paths

    def on_step(self, data: Any, time: float) -> None:
        """Where they are now."""
        for body, thing in self._paths:
            data.mocap_pos[body] = place_on(thing, time)


class MovingObstacles(PhysicsEffect):
    """Bodies whose pose is set each control period; they push, and nothing pushes them."""

    name = "moving_obstacles"
    cost = "an interpolation for each obstacle, and contacts that keep changing"
    observable = "obstacle_travel"

    def called_for(self, scene: Scene) -> str:
        """Something has a path."""
        return f"{names_of(scene.carried)} moves by itself" if scene.carried else ""

    def not_called_for(self, scene: Scene) -> str:
        """Nothing has."""
        return "nothing moves by itself"

    def build(self, draft: Draft) -> None:
        """Bodies that may be placed at any time."""
        for thing in draft.scene.carried:
            draft.bodies[thing.name].mocap = True

    def hook(self, model: Any, scene: Scene) -> Hook | None:
        """Carries them."""
        return Carried([(int(model.body(f"object/{t.name}").mocapid[0]), t) for t in scene.carried])


EFFECT = MovingObstacles()
