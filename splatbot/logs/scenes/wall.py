"""One flat wall (y = 0) that fills the view: depth does not constrain translation along it or rotation about y."""

from __future__ import annotations

from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.shapes import box
from splatbot.logs.textures import Texture
from splatbot.logs.trajectories import Stage

WALL_STAGE = Stage(eye=(0.0, -1.20, 0.25), target=(0.0, 0.0, 0.0), ahead=0.6)


def wall() -> RaycastScene:
    """Build the wall with a texture that has corners."""
    return _wall(Texture((0.90, 0.86, 0.78), (0.30, 0.36, 0.45), 0.05, seed=11))


def wall_soft() -> RaycastScene:
    """Build the wall with colours that blend over half a metre."""
    return _wall(Texture((0.85, 0.80, 0.70), (0.45, 0.52, 0.60), 0.5, "soft", seed=12))


def wall_blank() -> RaycastScene:
    """Build the wall in one colour."""
    return _wall(Texture((0.80, 0.80, 0.78), (0.80, 0.80, 0.78), kind="plain"))


def _wall(texture: Texture) -> RaycastScene:
    return RaycastScene([RaycastSurface(box([60.0, 0.1, 60.0]).placed([0.0, 0.05, -30.0]), texture)])
