"""Obstacles that follow a prescribed path regardless of contacts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from splatbot.protocols import Array
from splatbot.sim.effects.physics import Hook, PhysicsEffect, names_of

if TYPE_CHECKING:
    from splatbot.sim.scene import Scene, SceneObject
    from splatbot.sim.world import Draft


def position_on_path(obj: SceneObject, time: float) -> Array:
    """Interpolate the position (3,) [m] of an object on its path at ``time`` [s], forwards and then backwards."""
    times, places = np.array([p.t for p in obj.path]), np.array([p.at for p in obj.path])
    length = times[-1]
    t = time % (2 * length)
    t = t if t <= length else 2 * length - t
    return np.array([np.interp(t, times, column) for column in places.T])


class PathFollower(Hook):
    """Moves each obstacle along its path and back."""

    def __init__(self, paths: list[tuple[int, SceneObject]]) -> None:
        self._paths = paths

    def on_step(self, data: Any, time: float) -> None:
        """Set the position of each obstacle at ``time`` [s]."""
        for body, obj in self._paths:
            data.mocap_pos[body] = position_on_path(obj, time)


class MovingObstacles(
    PhysicsEffect, cost="one interpolation for each obstacle, and changing contacts", observable="obstacle_travel"
):
    """Kinematic obstacles (MuJoCo mocap bodies), whose position is set in each control period.

    They push other bodies and are not pushed. The path is piecewise linear through waypoints (time [s], position [m]).
    """

    def required(self, scene: Scene) -> tuple[bool, str]:
        """Return whether an obstacle has a path, and why."""
        if not scene.carried:
            return False, "no object moves on a path"
        return True, f"{names_of(scene.carried)} moves on a path"

    def build(self, draft: Draft) -> None:
        """Make the obstacles mocap bodies."""
        for obj in draft.scene.carried:
            draft.bodies[obj.name].mocap = True

    def hook(self, model: Any, scene: Scene) -> Hook | None:
        """Create the hook that moves the obstacles."""
        return PathFollower([(int(model.body(f"object/{t.name}").mocapid[0]), t) for t in scene.carried])


EFFECT = MovingObstacles()
