"""Objects of trial scenes: primitives, hollow cups, mallets, and household shapes of convex parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from splatbot.geometry import transform_points
from splatbot.protocols import Array
from splatbot.sim.scene import SceneObject
from splatbot.sim.solids import pose_at
from splatbot.sim.trials.surfaces import mesh_of

Shapes = list[dict[str, Any]]
Maker = Callable[[np.random.Generator], "TrialObject"]

_AROUND = np.arange(16) * 2 * np.pi / 16  # corners of round hulls
_SIZE = (0.9, 1.1)  # range of the scale of household shapes


@dataclass(frozen=True)
class TrialObject:
    """An object of a trial scene.

    Args:
        kind: of object.
        shapes: in its own frame.
        height: of its origin over its support [m], half of its own height.
        radius: horizontal extent from its origin [m].
        fits: whether the hand fits around it.
    """

    kind: str
    shapes: tuple[dict[str, Any], ...]
    height: float
    radius: float
    fits: bool = True


def box(rng: np.random.Generator) -> TrialObject:
    """Create a box."""
    narrow, wide, high = (float(rng.uniform(*r)) for r in ((0.03, 0.062), (0.045, 0.11), (0.04, 0.12)))
    shape = {"kind": "box", "size": (wide, narrow, high)}
    return TrialObject("box", (shape,), high / 2, float(np.hypot(wide, narrow)) / 2)


def can(rng: np.random.Generator) -> TrialObject:
    """Create an upright cylinder."""
    r, h = float(rng.uniform(0.018, 0.033)), float(rng.uniform(0.06, 0.14))
    return TrialObject("can", ({"kind": "cylinder", "radius": r, "height": h},), h / 2, r)


def lying(rng: np.random.Generator) -> TrialObject:
    """Create a lying cylinder."""
    r, h = float(rng.uniform(0.02, 0.032)), float(rng.uniform(0.09, 0.14))
    shape = {"kind": "cylinder", "radius": r, "height": h, "rpy": [np.pi / 2, 0.0, 0.0]}
    return TrialObject("lying can", (shape,), r, float(np.hypot(r, h / 2)))


def ball(rng: np.random.Generator) -> TrialObject:
    """Create a sphere."""
    r = float(rng.uniform(0.022, 0.034))
    return TrialObject("ball", ({"kind": "sphere", "radius": r},), r, r)


def egg(rng: np.random.Generator) -> TrialObject:
    """Create an ellipsoid."""
    a, b, c = float(rng.uniform(0.03, 0.045)), float(rng.uniform(0.022, 0.032)), float(rng.uniform(0.022, 0.032))
    return TrialObject("egg", ({"kind": "ellipsoid", "axes": [a, b, c]},), c, a)


def book(rng: np.random.Generator) -> TrialObject:
    """Create a lying book, under which no finger fits."""
    size = (float(rng.uniform(0.15, 0.20)), float(rng.uniform(0.11, 0.14)), float(rng.uniform(0.02, 0.035)))
    around = float(np.hypot(*size[:2])) / 2
    return TrialObject("book", ({"kind": "box", "size": size},), size[2] / 2, around, False)


def cup(rng: np.random.Generator) -> TrialObject:
    """Create a cup, hollow and open at the top: staves around a bottom."""
    r, h = float(rng.uniform(0.028, 0.035)), float(rng.uniform(0.07, 0.11))
    return TrialObject("cup", tuple(_hollow(r, h)), h / 2, r)


def mallet(rng: np.random.Generator) -> TrialObject:
    """Create a mallet that lies on the table: a handle between a head and a knob, which keep it off the table."""
    r, length, head = float(rng.uniform(0.011, 0.015)), float(rng.uniform(0.13, 0.18)), float(rng.uniform(0.04, 0.05))
    shapes: tuple[dict[str, Any], ...] = (
        {"kind": "cylinder", "radius": r, "height": length, "rpy": [0.0, np.pi / 2, 0.0]},
        {"kind": "box", "size": [0.035, 0.07, head], "at": [length / 2, 0.0, 0.0]},
        {"kind": "box", "size": [0.02, head, head], "at": [-length / 2, 0.0, 0.0]},
    )
    return TrialObject("mallet", shapes, head / 2, length / 2 + 0.03)


CONVEX: tuple[Maker, ...] = (box, can, ball, lying, box, egg)


def household(kind: str, rng: np.random.Generator) -> TrialObject:
    """Create one of :data:`HOUSEHOLD` in a random size, with its origin at the centre of its bounding box."""
    shapes = _scaled(HOUSEHOLD[kind](rng), float(rng.uniform(*_SIZE)))
    vertices = _vertices(shapes)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = (low + high) / 2
    for shape in shapes:
        shape["at"] = [float(x) for x in np.asarray(shape.get("at", (0.0, 0.0, 0.0))) - middle]
    radius = float(np.linalg.norm((vertices - middle)[:, :2], axis=1).max())
    return TrialObject(kind, tuple(shapes), float(high[2] - low[2]) / 2, radius)


def _bottle(rng: np.random.Generator) -> Shapes:
    return _revolved([(0.030, 0.0), (0.031, 0.09), (0.013, 0.125), (0.013, 0.15)])


def _bowl(rng: np.random.Generator) -> Shapes:
    """Create a bowl: staves that lean outwards around a bottom."""
    staves = []
    for turn in _AROUND:
        corners = [_polar(r, z, turn + side) for side in (-0.21, 0.21) for r, z in _BOWL_WALL]
        staves.append(_hull(corners))
    return [*_revolved([(0.036, 0.0), (0.036, 0.006)]), *staves]


_BOWL_WALL = ((0.034, 0.0), (0.039, 0.0), (0.055, 0.045), (0.060, 0.045))  # [m] radius and height of its corners


def _mug(rng: np.random.Generator) -> Shapes:
    bend = [(0.034, 0.02), (0.055, 0.012), (0.062, -0.002), (0.055, -0.018), (0.034, -0.026)]
    return _hollow(0.036, 0.085) + _tube([(x, 0.0, z) for x, z in bend], 0.005)


def _banana(rng: np.random.Generator) -> Shapes:
    t = np.linspace(-0.75, 0.75, 6)
    return _tube([(0.10 * np.sin(a), 0.10 * (1 - np.cos(a)), 0.0) for a in t], 0.017)


def _pear(rng: np.random.Generator) -> Shapes:
    return _revolved([(0.015, 0.0), (0.030, 0.012), (0.033, 0.03), (0.027, 0.05), (0.017, 0.07), (0.008, 0.082)])


def _screwdriver(rng: np.random.Generator) -> Shapes:
    return _tube([(-0.09, 0.0, 0.0), (0.0, 0.0, 0.0)], 0.015) + _tube([(0.0, 0.0, 0.0), (0.10, 0.0, 0.0)], 0.004)


def _drill(rng: np.random.Generator) -> Shapes:
    return [
        {"kind": "box", "size": [0.07, 0.06, 0.035], "at": [0.0, 0.0, 0.0175]},
        {"kind": "box", "size": [0.032, 0.028, 0.08], "at": [-0.005, 0.0, 0.07]},
        {"kind": "cylinder", "radius": 0.022, "height": 0.10, "at": [0.02, 0.0, 0.125], "rpy": [0.0, np.pi / 2, 0.0]},
        {"kind": "cylinder", "radius": 0.008, "height": 0.04, "at": [0.09, 0.0, 0.125], "rpy": [0.0, np.pi / 2, 0.0]},
    ]


def _spray_bottle(rng: np.random.Generator) -> Shapes:
    head = _hull(
        [(x, y, z) for x, z in ((-0.02, 0.13), (0.035, 0.14), (-0.02, 0.16), (0.03, 0.16)) for y in (-9e-3, 9e-3)]
    )
    return [*_revolved([(0.032, 0.0), (0.032, 0.07), (0.012, 0.105), (0.012, 0.132)]), head]


def _shoe(rng: np.random.Generator) -> Shapes:
    sole = [(x, y, z) for x, y in ((-0.075, 0.024), (-0.02, 0.022), (0.04, 0.032), (0.08, 0.018)) for z in (0.0, 0.018)]
    heel = [(-0.075, 0.022, 0.018), (-0.01, 0.02, 0.018), (-0.07, 0.02, 0.065), (-0.025, 0.018, 0.065)]
    toe = [(-0.02, 0.022, 0.018), (0.075, 0.018, 0.018), (-0.025, 0.018, 0.055), (0.05, 0.018, 0.03)]
    return [_hull(_mirrored(part)) for part in (sole, heel, toe)]


def _toy_car(rng: np.random.Generator) -> Shapes:
    body = _mirrored([(x, 0.024, z) for x in (-0.065, 0.065) for z in (0.012, 0.038)])
    cabin = _mirrored([(-0.04, 0.023, 0.038), (0.025, 0.023, 0.038), (-0.03, 0.018, 0.062), (0.01, 0.018, 0.062)])
    turned = {"rpy": [np.pi / 2, 0.0, 0.0]}
    wheels = [
        {"kind": "cylinder", "radius": 0.014, "height": 0.012, "at": [x, y, 0.014], **turned}
        for x in (-0.042, 0.042)
        for y in (-0.024, 0.024)
    ]
    return [_hull(body), _hull(cabin), *wheels]


def _tape_roll(rng: np.random.Generator) -> Shapes:
    return [
        _hull([_polar(r, z, turn + side) for side in (-0.21, 0.21) for r in (0.027, 0.044) for z in (0.0, 0.03)])
        for turn in _AROUND
    ]


def _elbow(rng: np.random.Generator) -> Shapes:
    return _tube([(0.0, 0.0, 0.0), (0.07, 0.0, 0.0)], 0.020) + _tube([(0.0, 0.0, 0.0), (0.0, 0.07, 0.0)], 0.020)


def _tee(rng: np.random.Generator) -> Shapes:
    return _tube([(-0.055, 0.0, 0.0), (0.055, 0.0, 0.0)], 0.018) + _tube([(0.0, 0.0, 0.0), (0.0, 0.065, 0.0)], 0.018)


def _jack(rng: np.random.Generator) -> Shapes:
    return [shape for axis in 0.04 * np.eye(3) for shape in _tube([tuple(-axis), tuple(axis)], 0.011)]


def _dumbbell(rng: np.random.Generator) -> Shapes:
    ends: Shapes = [{"kind": "sphere", "radius": 0.028, "at": [x, 0.0, 0.0]} for x in (-0.05, 0.05)]
    return ends + _tube([(-0.05, 0.0, 0.0), (0.05, 0.0, 0.0)], 0.012)


def _wedge(rng: np.random.Generator) -> Shapes:
    return [_hull(_mirrored([(-0.05, 0.026, 0.0), (0.05, 0.026, 0.0), (-0.05, 0.026, 0.07)]))]


def _potato(rng: np.random.Generator) -> Shapes:
    directions = rng.standard_normal((40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return [_hull(directions * rng.uniform(0.9, 1.1, (40, 1)) * [0.045, 0.030, 0.027])]


def _tube_of_paste(rng: np.random.Generator) -> Shapes:
    """Create a tube of toothpaste: round at one end and flat at the other."""
    end = [(0.0, 0.019 * float(np.cos(a)), 0.019 + 0.019 * float(np.sin(a))) for a in _AROUND]
    flat = [(0.12, y, z) for y in (-0.028, 0.028) for z in (0.016, 0.022)]
    lid = {
        "kind": "cylinder",
        "radius": 0.012,
        "height": 0.025,
        "at": [-0.0125, 0.0, 0.019],
        "rpy": [0.0, np.pi / 2, 0.0],
    }
    return [_hull([*end, *flat]), lid]


def _bear(rng: np.random.Generator) -> Shapes:
    parts = [
        (0.032, (0.0, 0.0, 0.0)), (0.023, (0.0, 0.0, 0.046)), (0.009, (0.0, 0.018, 0.064)),
        (0.009, (0.0, -0.018, 0.064)), (0.014, (0.03, 0.02, -0.018)), (0.014, (0.03, -0.02, -0.018)),
        (0.012, (0.012, 0.034, 0.012)), (0.012, (0.012, -0.034, 0.012)),
    ]  # fmt: skip
    return [{"kind": "sphere", "radius": radius, "at": list(at)} for radius, at in parts]


def _camera(rng: np.random.Generator) -> Shapes:
    lens = {"kind": "cylinder", "radius": 0.026, "height": 0.05, "at": [0.0, 0.04, 0.036], "rpy": [np.pi / 2, 0.0, 0.0]}
    finder = _hull([(x, y, 0.07) for x in (-0.02, 0.02) for y in (-0.015, 0.015)] + [(0.0, 0.0, 0.088)])
    return [{"kind": "box", "size": [0.11, 0.038, 0.072], "at": [0.0, 0.0, 0.036]}, lens, finder]


def _house(rng: np.random.Generator) -> Shapes:
    roof = _hull([(x, y, 0.06) for x in (-0.04, 0.04) for y in (-0.03, 0.03)] + [(-0.04, 0.0, 0.09), (0.04, 0.0, 0.09)])
    return [{"kind": "box", "size": [0.07, 0.052, 0.06], "at": [0.0, 0.0, 0.03]}, roof]


HOUSEHOLD: dict[str, Callable[[np.random.Generator], Shapes]] = {
    "bottle": _bottle, "bowl": _bowl, "mug": _mug, "banana": _banana, "pear": _pear, "screwdriver": _screwdriver,
    "drill": _drill, "spray bottle": _spray_bottle, "shoe": _shoe, "toy car": _toy_car, "tape roll": _tape_roll,
    "elbow": _elbow, "tee": _tee, "jack": _jack, "dumbbell": _dumbbell, "wedge": _wedge, "potato": _potato,
    "tube": _tube_of_paste, "bear": _bear, "camera": _camera, "house": _house,
}  # fmt: skip
"""Household shapes, as convex parts."""


def _hollow(r: float, h: float) -> Shapes:
    """Return the staves and the bottom of a cup of radius ``r`` and height ``h`` [m] about its centre."""
    wall, staves = 0.004, 16
    middle = r - wall / 2
    wide = 2 * middle * np.tan(np.pi / staves) + wall / 2
    shapes: Shapes = [{"kind": "cylinder", "radius": r - wall / 2, "height": 0.006, "at": [0.0, 0.0, 0.003 - h / 2]}]
    for turn in np.arange(staves) * 2 * np.pi / staves:
        at = [middle * float(np.cos(turn)), middle * float(np.sin(turn)), 0.0]
        shapes.append({"kind": "box", "size": [wall, wide, h], "at": at, "rpy": [0.0, 0.0, float(turn)]})
    return shapes


def _revolved(profile: Sequence[tuple[float, float]]) -> Shapes:
    """Return a frustum between each two neighbours of a profile of radius and height [m] about z."""
    return [_hull([_polar(r, z, turn) for r, z in part for turn in _AROUND]) for part in pairwise(profile)]


def _tube(points: Sequence[Sequence[float]], radius: float) -> Shapes:
    """Return capsules between neighbouring points [m]."""
    found: Shapes = []
    for a, b in pairwise(np.asarray(points, dtype=np.float64)):
        along = b - a
        length = float(np.linalg.norm(along))
        pitch, yaw = float(np.arccos(along[2] / length)), float(np.arctan2(along[1], along[0]))
        shape = {"kind": "capsule", "radius": radius, "height": length, "rpy": [0.0, pitch, yaw]}
        found.append({**shape, "at": ((a + b) / 2).tolist()})
    return found


def _hull(points: Any) -> dict[str, Any]:
    return {"kind": "mesh", "points": [tuple(float(x) for x in p) for p in points]}


def _mirrored(points: Sequence[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Return the points and their mirror images across y = 0."""
    return [*points, *((x, -y, z) for x, y, z in points)]


def _polar(radius: float, z: float, turn: float) -> tuple[float, float, float]:
    return radius * float(np.cos(turn)), radius * float(np.sin(turn)), z


def _scaled(shapes: Shapes, factor: float) -> Shapes:
    """Return shapes enlarged by a factor about the origin."""
    found = []
    for shape in shapes:
        scaled = dict(shape)
        for key in ("radius", "height"):
            if key in shape:
                scaled[key] = factor * shape[key]
        for key in ("size", "at", "axes"):
            if key in shape:
                scaled[key] = [factor * float(x) for x in shape[key]]
        if "points" in shape:
            scaled["points"] = [tuple(factor * x for x in p) for p in shape["points"]]
        found.append(scaled)
    return found


def _vertices(shapes: Shapes) -> Array:
    """Return the vertices (V, 3) [m] of the meshes of all shapes."""
    obj = SceneObject.model_validate({"name": "shape", "shapes": shapes})
    return np.concatenate([transform_points(pose_at(s.at, s.rpy), mesh_of(s, obj.name).vertices) for s in obj.shapes])
