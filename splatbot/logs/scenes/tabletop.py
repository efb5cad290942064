"""A table (top at z = 0, z up) in the corner of a room, with two boxes, a can, a ball and a mug on it."""

from __future__ import annotations

import numpy as np

from splatbot.logs.raycast import Array, Moving, RaycastScene, RaycastSurface
from splatbot.logs.shapes import TriangleMesh, box, cup, cylinder, handle, sphere
from splatbot.logs.textures import Texture
from splatbot.logs.trajectories import Stage

TABLETOP_STAGE = Stage(eye=(0.0, -0.80, 0.50), target=(0.0, 0.0, 0.0), ahead=0.35)

_CARTON = Texture((0.90, 0.80, 0.25), (0.70, 0.20, 0.15), 0.035, seed=2)
_CARTON_AT, _CARTON_YAW = (-0.22, 0.05, 0.0), 0.5
_CROSSING_S = 2.5  # for 1.5 m: 2 cm per frame at 30 Hz
_CROSSING_FROM, _CROSSING_TO = np.array([-0.75, -0.45, 0.28]), np.array([0.75, -0.45, 0.28])


def tabletop() -> RaycastScene:
    """Build the static scene."""
    return RaycastScene([*_furniture(), RaycastSurface(_carton().placed(_CARTON_AT, _CARTON_YAW), _CARTON)])


def tabletop_crossing(event: float) -> RaycastScene:
    """Build the scene with a hand that crosses in front of the table from -x to +x, for 2.5 s from ``event`` [s] on."""
    return RaycastScene(
        [*_furniture(), RaycastSurface(_carton().placed(_CARTON_AT, _CARTON_YAW), _CARTON)],
        {"hand": Moving(_hand(), lambda t: _crossing((t - event) / _CROSSING_S))},
    )


def tabletop_removed(event: float) -> RaycastScene:
    """Build the scene with a carton that vanishes at ``event`` [s]."""
    T = np.eye(4)
    T[:3, 3] = _CARTON_AT
    turned = RaycastSurface(_carton().placed([0.0, 0.0, 0.0], _CARTON_YAW), _CARTON)
    return RaycastScene(_furniture(), {"carton": Moving([turned], lambda t: T if t < event else None)})


def _carton() -> TriangleMesh:
    return box([0.16, 0.10, 0.12])


def _furniture() -> list[RaycastSurface]:
    wood = Texture((0.80, 0.62, 0.42), (0.45, 0.30, 0.18), 0.04)
    wall = Texture((0.85, 0.85, 0.80), (0.55, 0.62, 0.68), 0.12, seed=1)
    floor = Texture((0.60, 0.58, 0.55), (0.30, 0.30, 0.33), 0.30, "checker")
    book = Texture((0.90, 0.90, 0.95), (0.10, 0.20, 0.55), 0.05, "checker", seed=3)
    can = Texture((0.20, 0.70, 0.35), (0.90, 0.90, 0.85), 0.03, seed=4)
    ball = Texture((0.95, 0.55, 0.15), (0.35, 0.10, 0.40), 0.03, seed=5)
    glaze = Texture((0.85, 0.88, 0.92), (0.15, 0.40, 0.60), 0.025, seed=6)
    mug_at, mug_yaw = np.array([0.22, -0.12, 0.0]), -0.9
    mug_handle = np.array([0.040 * np.cos(mug_yaw), 0.040 * np.sin(mug_yaw), 0.05]) + mug_at
    return [
        RaycastSurface(box([1.2, 0.8, 0.04]).placed([0, 0, -0.04]), wood),
        RaycastSurface(box([6.0, 6.0, 0.02]).placed([0, 0, -0.76]), floor),
        RaycastSurface(box([6.0, 0.02, 3.0]).placed([0, 0.75, -0.75]), wall),
        RaycastSurface(box([0.02, 6.0, 3.0]).placed([-1.1, 0, -0.75]), wall),
        RaycastSurface(box([0.20, 0.14, 0.03]).placed([-0.05, -0.16, 0], -0.25), book),
        RaycastSurface(cylinder(0.035, 0.12).placed([0.08, 0.12, 0]), can),
        RaycastSurface(sphere(0.05).placed([-0.30, -0.18, 0]), ball),
        RaycastSurface(cup(0.042, 0.10, 0.004).placed(mug_at), glaze),
        RaycastSurface(handle(0.028, 0.006).placed(mug_handle, mug_yaw), glaze),
    ]


def _hand() -> list[RaycastSurface]:
    """Build a palm with four fingers, 18 x 9 x 3 cm, pointing to +x."""
    skin = Texture((0.85, 0.62, 0.50), (0.70, 0.42, 0.34), 0.03, seed=8)
    fingers = [box([0.08, 0.018, 0.018]).placed([0.09, y, 0.005]) for y in (-0.036, -0.012, 0.012, 0.036)]
    return [RaycastSurface(mesh, skin) for mesh in (box([0.10, 0.09, 0.03]), *fingers)]


def _crossing(fraction: float) -> Array | None:
    """Return T_world_hand after a ``fraction`` of the path; None before and after."""
    if not 0.0 <= fraction <= 1.0:
        return None
    T = np.eye(4)
    T[:3, 3] = _CROSSING_FROM + fraction * (_CROSSING_TO - _CROSSING_FROM)
    return T
