"""The scenes of synthetic logs, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.scenes.corridor import CORRIDOR_STAGE, corridor
from splatbot.logs.scenes.room import ROOM_STAGE, room
from splatbot.logs.scenes.tabletop import TABLETOP_STAGE, tabletop, tabletop_crossing, tabletop_removed
from splatbot.logs.scenes.wall import WALL_STAGE, wall, wall_blank, wall_soft
from splatbot.logs.trajectories import Stage

__all__ = ["SCENES", "RaycastScene", "RaycastSurface", "SceneKind"]


@dataclass(frozen=True)
class SceneKind:
    """Definition of a scene and of its camera motion.

    Args:
        build: builds the scene for the time [s] of its event, such as a moving or vanishing object; static scenes
            ignore it.
        stage: free space of the camera in the scene.
        trajectory: default camera trajectory.
        about: purpose of the scene in one line.
    """

    build: Callable[[float], RaycastScene]
    stage: Stage
    trajectory: str
    about: str


SCENES = {
    "tabletop": SceneKind(lambda _: tabletop(), TABLETOP_STAGE, "orbit", "five objects on a table in a corner"),
    "tabletop_crossing": SceneKind(
        tabletop_crossing, TABLETOP_STAGE, "orbit", "a hand-sized object crosses in front of it after the event"
    ),
    "tabletop_removed": SceneKind(tabletop_removed, TABLETOP_STAGE, "orbit", "its carton vanishes at the event"),
    "room": SceneKind(lambda _: room(), ROOM_STAGE, "loop", "furniture along the walls of a room of 5 x 4 m"),
    "wall": SceneKind(
        lambda _: wall(), WALL_STAGE, "orbit", "flat, with texture: geometry constrains 3 of 6 degrees of freedom"
    ),
    "wall_soft": SceneKind(lambda _: wall_soft(), WALL_STAGE, "orbit", "flat, with smooth colours: no corners for ORB"),
    "wall_blank": SceneKind(
        lambda _: wall_blank(), WALL_STAGE, "orbit", "flat, of one colour: 3 degrees of freedom are unobservable"
    ),
    "corridor": SceneKind(
        lambda _: corridor(), CORRIDOR_STAGE, "forward", "10 m long; its walls do not constrain forward motion"
    ),
}
