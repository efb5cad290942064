"""A bare corridor along y, 1.8 m wide, 2.5 m high and 10 m long."""

from __future__ import annotations

from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.shapes import box
from splatbot.logs.textures import Texture
from splatbot.logs.trajectories import Stage

CORRIDOR_STAGE = Stage(
    eye=(0.0, 0.6, 1.3), target=(0.0, 9.0, 1.3), ahead=7.0, paths=("forward", "handheld", "rotation", "steps")
)

_LENGTH, _WIDTH, _HEIGHT, _WALL_THICKNESS = 10.0, 1.8, 2.5, 0.1


def corridor() -> RaycastScene:
    """Build a corridor with flat walls: only colour, and the end walls from near, constrain the motion along it."""
    plaster = Texture((0.86, 0.85, 0.80), (0.52, 0.56, 0.60), 0.15, seed=21)
    carpet = Texture((0.45, 0.45, 0.50), (0.25, 0.27, 0.32), 0.10, seed=22)
    ceiling = Texture((0.90, 0.90, 0.90), (0.74, 0.74, 0.72), 0.60, "checker")
    door = Texture((0.62, 0.44, 0.28), (0.42, 0.28, 0.16), 0.12, seed=23)
    sides = [
        RaycastSurface(
            box([_WALL_THICKNESS, _LENGTH, _HEIGHT]).placed([x * (_WIDTH + _WALL_THICKNESS) / 2, _LENGTH / 2, 0.0]),
            plaster,
        )
        for x in (-1, 1)
    ]
    ends = [
        RaycastSurface(box([_WIDTH, _WALL_THICKNESS, _HEIGHT]).placed([0.0, y, 0.0]), door)
        for y in (-_WALL_THICKNESS / 2, _LENGTH + _WALL_THICKNESS / 2)
    ]
    return RaycastScene(
        [
            *sides,
            *ends,
            RaycastSurface(
                box([_WIDTH, _LENGTH, _WALL_THICKNESS]).placed([0.0, _LENGTH / 2, -_WALL_THICKNESS]), carpet
            ),
            RaycastSurface(box([_WIDTH, _LENGTH, _WALL_THICKNESS]).placed([0.0, _LENGTH / 2, _HEIGHT]), ceiling),
        ]
    )
