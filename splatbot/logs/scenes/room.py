"""A room of 5 x 4 x 2.6 m (floor at z = 0) with its furniture along the walls."""

from __future__ import annotations

from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.shapes import box, cylinder, sphere
from splatbot.logs.textures import Texture
from splatbot.logs.trajectories import Stage

ROOM_STAGE = Stage(
    eye=(0.0, -1.0, 1.30), target=(0.0, 1.4, 0.70), ahead=1.2, circuit_center=(0.0, 0.0, 1.30), circuit_radius=0.85
)

_X, _Y, _Z, _WALL_THICKNESS = 5.0, 4.0, 2.6, 0.1


def room() -> RaycastScene:
    """Build a room with texture and relief in every direction; the centre is free within 1.1 m."""
    return RaycastScene([*_shell(), *_sofa(), *_desk(), *_shelf(), *_cabinet()])


def _shell() -> list[RaycastSurface]:
    paper = Texture((0.86, 0.84, 0.76), (0.45, 0.54, 0.50), 0.07, seed=31)
    boards = Texture((0.66, 0.50, 0.34), (0.42, 0.30, 0.20), 0.16, seed=32)
    ceiling = Texture((0.92, 0.92, 0.90), (0.78, 0.78, 0.76), 0.50, "checker")
    return [
        RaycastSurface(box([_X, _Y, _WALL_THICKNESS]).placed([0, 0, -_WALL_THICKNESS]), boards),
        RaycastSurface(box([_X, _Y, _WALL_THICKNESS]).placed([0, 0, _Z]), ceiling),
        *(
            RaycastSurface(box([_X, _WALL_THICKNESS, _Z]).placed([0, y * (_Y + _WALL_THICKNESS) / 2, 0]), paper)
            for y in (-1, 1)
        ),
        *(
            RaycastSurface(box([_WALL_THICKNESS, _Y, _Z]).placed([x * (_X + _WALL_THICKNESS) / 2, 0, 0]), paper)
            for x in (-1, 1)
        ),
    ]


def _sofa() -> list[RaycastSurface]:
    """Build the sofa at +y, with a picture above it."""
    cloth = Texture((0.30, 0.42, 0.58), (0.18, 0.24, 0.38), 0.05, seed=33)
    cushion = Texture((0.85, 0.60, 0.25), (0.65, 0.30, 0.18), 0.06, "checker", seed=34)
    picture = Texture((0.92, 0.88, 0.70), (0.20, 0.45, 0.42), 0.09, seed=35)
    return [
        RaycastSurface(box([1.8, 0.70, 0.42]).placed([-0.2, 1.60, 0]), cloth),
        RaycastSurface(box([1.8, 0.18, 0.45]).placed([-0.2, 1.90, 0.42]), cloth),
        *(RaycastSurface(box([0.16, 0.70, 0.25]).placed([-0.2 + x, 1.60, 0.42]), cloth) for x in (-0.82, 0.82)),
        RaycastSurface(box([0.40, 0.15, 0.36]).placed([-0.65, 1.70, 0.42], 0.3), cushion),
        RaycastSurface(sphere(0.14).placed([0.25, 1.55, 0.42]), cushion),
        RaycastSurface(box([0.9, 0.04, 0.6]).placed([-0.1, 1.98, 1.35]), picture),
    ]


def _desk() -> list[RaycastSurface]:
    """Build the desk at +x, with a screen, books and a lamp."""
    wood = Texture((0.80, 0.62, 0.42), (0.52, 0.36, 0.22), 0.08, seed=36)
    screen = Texture((0.15, 0.30, 0.55), (0.05, 0.06, 0.10), 0.10, "checker", seed=37)
    books = Texture((0.80, 0.25, 0.22), (0.90, 0.88, 0.80), 0.05, seed=38)
    lamp = Texture((0.90, 0.80, 0.30), (0.55, 0.40, 0.10), 0.06, seed=39)
    return [
        RaycastSurface(box([0.70, 1.50, 0.04]).placed([2.10, 0.1, 0.70]), wood),
        *(RaycastSurface(box([0.60, 0.04, 0.70]).placed([2.10, 0.1 + y, 0]), wood) for y in (-0.70, 0.70)),
        RaycastSurface(box([0.05, 0.60, 0.36]).placed([2.20, 0.2, 0.84], 0.15), screen),
        RaycastSurface(cylinder(0.03, 0.12).placed([2.22, 0.2, 0.74]), screen),
        RaycastSurface(box([0.22, 0.30, 0.16]).placed([2.05, -0.40, 0.74], 0.4), books),
        RaycastSurface(cylinder(0.02, 0.40).placed([2.25, 0.70, 0.74]), lamp),
        RaycastSurface(sphere(0.11).placed([2.25, 0.70, 1.10]), lamp),
    ]


def _shelf() -> list[RaycastSurface]:
    """Build the shelf at -x: three boards with boxes and balls."""
    board = Texture((0.72, 0.70, 0.66), (0.50, 0.46, 0.42), 0.09, seed=40)
    boxes = Texture((0.70, 0.78, 0.30), (0.30, 0.34, 0.16), 0.06, seed=41)
    balls = Texture((0.90, 0.45, 0.55), (0.45, 0.15, 0.30), 0.06, seed=42)
    parts = [RaycastSurface(box([0.34, 1.60, 0.03]).placed([-2.30, 0.0, z]), board) for z in (0.40, 0.95, 1.50)]
    parts += [RaycastSurface(box([0.34, 0.03, 1.90]).placed([-2.30, y, 0]), board) for y in (-0.80, 0.0, 0.80)]
    for i, z in enumerate((0.43, 0.98, 1.53)):
        parts.append(RaycastSurface(box([0.20, 0.26, 0.20]).placed([-2.28, -0.45 + 0.1 * i, z], 0.2 * i), boxes))
        parts.append(RaycastSurface(sphere(0.10).placed([-2.25, 0.30 + 0.12 * i, z]), balls))
    return parts


def _cabinet() -> list[RaycastSurface]:
    """Build the cabinet at -y, with a plant next to it."""
    paint = Texture((0.78, 0.84, 0.86), (0.44, 0.54, 0.60), 0.06, seed=43)
    pot = Texture((0.74, 0.42, 0.28), (0.50, 0.26, 0.18), 0.06, seed=44)
    leaves = Texture((0.35, 0.65, 0.28), (0.12, 0.30, 0.12), 0.05, seed=45)
    return [
        RaycastSurface(box([1.30, 0.45, 0.90]).placed([0.5, -1.75, 0]), paint),
        RaycastSurface(box([0.35, 0.25, 0.25]).placed([0.2, -1.75, 0.90], 0.35), pot),
        RaycastSurface(cylinder(0.09, 0.30).placed([0.8, -1.75, 0.90]), leaves),
        RaycastSurface(cylinder(0.17, 0.35).placed([-1.5, -1.6, 0]), pot),
        RaycastSurface(sphere(0.32).placed([-1.5, -1.6, 0.40]), leaves),
    ]
