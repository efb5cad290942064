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
    """How a scene is made and filmed.

    Args:
        build: makes the scene, given the time [s] of its event (what moves or goes); still scenes ignore it.
        stage: where a camera may move in it.
        trajectory: how it moves unless told otherwise.
        about: a line on what the scene is for.
    """

    build: Callable[[float], RaycastScene]
    stage: Stage
    trajectory: str
    about: str


SCENES = {
    "tabletop": SceneKind(lambda _: tabletop(), TABLETOP_STAGE, "orbit", "five things on a table in a corner"),
    "tabletop_crossing": SceneKind(
        tabletop_crossing, TABLETOP_STAGE, "orbit", "a hand-sized object crosses in front of it, from the event on"
    ),
    "tabletop_removed": SceneKind(tabletop_removed, TABLETOP_STAGE, "orbit", "its carton is gone from the event on"),
    "room": SceneKind(lambda _: room(), ROOM_STAGE, "loop", "furniture along the walls of a room of 5 x 4 m"),
    "wall": SceneKind(lambda _: wall(), WALL_STAGE, "orbit", "flat, with texture: geometry fixes 3 of 6 freedoms"),
    "wall_soft": SceneKind(lambda _: wall_soft(), WALL_STAGE, "orbit", "flat, colours fade: no corner for ORB"),
    "wall_blank": SceneKind(lambda _: wall_blank(), WALL_STAGE, "orbit", "flat and of one colour: 3 freedoms unseen"),
    "corridor": SceneKind(
        lambda _: corridor(), CORRIDOR_STAGE, "forward", "10 m long; its walls do not fix the way on"
    ),
}
