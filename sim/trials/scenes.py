"""Seeded table-top scenes to pick from: single convex objects, or cups, tools and clutter with a moving obstacle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatbot.errors import InputError
from splatbot.protocols import Array
from splatbot.sim.scene import Scene, make_scene
from splatbot.sim.solids import rpy_of
from splatbot.sim.twin import Twin
from splatbot.sim.world import OBJECT

FAMILIES = ("tabletop", "isolated")
TABLE, OBSTACLE = "table", "obstacle"
SENSOR = ("depth_noise", "depth_holes:share=0.05")


@dataclass(frozen=True)
class SceneConstants:
    """Constants of random trial scenes.

    Args:
        area: [m] corners of the area with objects.
        spacing: [m] range of the clearance between objects.
        mass: [kg] range of an object's mass.
        friction: range of an object's friction coefficient.
        settling_time: [s] time until all objects are at rest.
        moving_period: every n-th table top has a moving obstacle.
        max_tries: largest number of random places of an object.
    """

    area: tuple[tuple[float, float], tuple[float, float]] = ((0.36, -0.26), (0.64, 0.26))
    spacing: tuple[float, float] = (0.02, 0.05)
    mass: tuple[float, float] = (0.1, 0.5)
    friction: tuple[float, float] = (0.5, 0.9)
    settling_time: float = 1.5
    moving_period: int = 5
    max_tries: int = 300


CONSTANTS = SceneConstants()


_COLORS = (
    (0.85, 0.20, 0.18), (0.20, 0.45, 0.85), (0.95, 0.75, 0.15), (0.25, 0.65, 0.35), (0.60, 0.30, 0.70),
    (0.95, 0.50, 0.15), (0.90, 0.90, 0.88), (0.30, 0.75, 0.75),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class TrialScene:
    """Scene and target of a trial.

    Args:
        scene: of the twin, with all objects at rest; the robot's base is its origin.
        target: name of the object to pick.
        kind: of the target.
        seed: of this scene.
        family: of :data:`FAMILIES`.
        moving: whether an obstacle moves through the scene.
    """

    scene: Scene
    target: str
    kind: str
    seed: int
    family: str
    moving: bool


@dataclass(frozen=True)
class _TrialObject:
    """An object on the table.

    Args:
        kind: of object.
        shapes: in its own frame.
        height: of its origin over the table [m].
        radius: horizontal extent from its origin [m].
        fits: whether the hand fits around it.
    """

    kind: str
    shapes: tuple[dict[str, Any], ...]
    height: float
    radius: float
    fits: bool = True


def make_trial(seed: int, family: str = "tabletop") -> TrialScene:
    """Create the scene of a seed; the same seed gives the same scene.

    Physics brings all objects to rest before the scan.

    Raises:
        InputError: the family is unknown.
    """
    if family not in FAMILIES:
        raise InputError(f"is {family!r}.", field="scenes", hint=f"one of {', '.join(FAMILIES)}")
    rng = np.random.default_rng((FAMILIES.index(family), seed))
    items = [_CONVEX[seed % len(_CONVEX)](rng)] if family == "isolated" else _table_top(rng)
    moving = family == "tabletop" and seed % CONSTANTS.moving_period == CONSTANTS.moving_period - 1
    placed = _placed(items, rng)
    values = [value for _, value in placed]
    k = int(rng.choice([k for k, (item, _) in enumerate(placed) if item.fits]))
    objects = [{"name": TABLE, "shapes": [{"kind": "plane"}], "color": [0.55, 0.45, 0.35]}, *values]
    if moving:
        objects.append(_obstacle(rng))
    scene = make_scene(
        {
            "name": f"{family}-{seed}",
            "objects": objects,
            "camera": {"at": [1.25, -0.85, 0.75], "look_at": [0.45, 0.0, 0.12], "sensor": SENSOR},
            "task": {"kind": "grasp"},
        }
    )
    return TrialScene(_settled(scene), str(values[k]["name"]), placed[k][0].kind, seed, family, moving)


def _table_top(rng: np.random.Generator) -> list[_TrialObject]:
    items = [_cup(rng), _tool(rng), _can(rng), _box(rng)]
    more: list[Callable[[np.random.Generator], _TrialObject]] = [_cup, _tool, _ball, _book, _box, _lying]
    chosen = rng.choice(len(more), int(rng.integers(1, 4)), replace=False)
    return items + [more[k](rng) for k in chosen]


def _box(rng: np.random.Generator) -> _TrialObject:
    narrow, wide, high = (float(rng.uniform(*r)) for r in ((0.03, 0.062), (0.045, 0.11), (0.04, 0.12)))
    size = (wide, narrow, high)
    shape = {"kind": "box", "size": size}
    return _TrialObject("box", (shape,), high / 2, float(np.hypot(wide, narrow)) / 2)


def _can(rng: np.random.Generator) -> _TrialObject:
    r, h = float(rng.uniform(0.018, 0.033)), float(rng.uniform(0.06, 0.14))
    return _TrialObject("can", ({"kind": "cylinder", "radius": r, "height": h},), h / 2, r)


def _lying(rng: np.random.Generator) -> _TrialObject:
    r, h = float(rng.uniform(0.02, 0.032)), float(rng.uniform(0.09, 0.14))
    shape = {"kind": "cylinder", "radius": r, "height": h, "rpy": [np.pi / 2, 0.0, 0.0]}
    return _TrialObject("lying can", (shape,), r, float(np.hypot(r, h / 2)))


def _ball(rng: np.random.Generator) -> _TrialObject:
    r = float(rng.uniform(0.022, 0.034))
    return _TrialObject("ball", ({"kind": "sphere", "radius": r},), r, r)


def _egg(rng: np.random.Generator) -> _TrialObject:
    a, b, c = float(rng.uniform(0.03, 0.045)), float(rng.uniform(0.022, 0.032)), float(rng.uniform(0.022, 0.032))
    return _TrialObject("egg", ({"kind": "ellipsoid", "axes": [a, b, c]},), c, a)


def _book(rng: np.random.Generator) -> _TrialObject:
    size = (float(rng.uniform(0.15, 0.20)), float(rng.uniform(0.11, 0.14)), float(rng.uniform(0.02, 0.035)))
    around = float(np.hypot(*size[:2])) / 2
    return _TrialObject("book", ({"kind": "box", "size": size},), size[2] / 2, around, False)


def _cup(rng: np.random.Generator) -> _TrialObject:
    """Create a cup, hollow and open at the top: staves around a bottom."""
    r, h, wall, staves = float(rng.uniform(0.028, 0.035)), float(rng.uniform(0.07, 0.11)), 0.004, 16
    middle = r - wall / 2
    wide = 2 * middle * np.tan(np.pi / staves) + wall / 2
    shapes: list[dict[str, Any]] = [
        {"kind": "cylinder", "radius": r - wall / 2, "height": 0.006, "at": [0.0, 0.0, 0.003 - h / 2]}
    ]
    for turn in np.arange(staves) * 2 * np.pi / staves:
        at = [middle * float(np.cos(turn)), middle * float(np.sin(turn)), 0.0]
        shapes.append({"kind": "box", "size": [wall, wide, h], "at": at, "rpy": [0.0, 0.0, float(turn)]})
    return _TrialObject("cup", tuple(shapes), h / 2, r)


def _tool(rng: np.random.Generator) -> _TrialObject:
    """Create a mallet that lies on the table: a handle between a head and a knob, which keep it off the table."""
    r, length, head = float(rng.uniform(0.011, 0.015)), float(rng.uniform(0.13, 0.18)), float(rng.uniform(0.04, 0.05))
    shapes: tuple[dict[str, Any], ...] = (
        {"kind": "cylinder", "radius": r, "height": length, "rpy": [0.0, np.pi / 2, 0.0]},
        {"kind": "box", "size": [0.035, 0.07, head], "at": [length / 2, 0.0, 0.0]},
        {"kind": "box", "size": [0.02, head, head], "at": [-length / 2, 0.0, 0.0]},
    )
    return _TrialObject("mallet", shapes, head / 2, length / 2 + 0.03)


_CONVEX: tuple[Callable[[np.random.Generator], _TrialObject], ...] = (_box, _can, _ball, _lying, _box, _egg)


def _placed(items: list[_TrialObject], rng: np.random.Generator) -> list[tuple[_TrialObject, dict[str, Any]]]:
    """Place objects at random without overlap; an object without a free place is left out."""
    taken: list[tuple[Array, float]] = []
    found: list[tuple[_TrialObject, dict[str, Any]]] = []
    colors = rng.permutation(len(_COLORS))
    for k, item in enumerate(items):
        apart = float(rng.uniform(*CONSTANTS.spacing))
        at = _free_place(item.radius + apart, taken, rng)
        if at is None:
            continue
        taken.append((at, item.radius))
        value = {
            "name": f"{item.kind.replace(' ', '-')}-{k}",
            "shapes": item.shapes,
            "at": [*at.tolist(), item.height + 5e-4],
            "rpy": [0.0, 0.0, float(rng.uniform(-np.pi, np.pi))],
            "movable": True,
            "mass": float(rng.uniform(*CONSTANTS.mass)),
            "friction": float(rng.uniform(*CONSTANTS.friction)),
            "color": _COLORS[colors[k % len(_COLORS)]],
        }
        found.append((item, value))
    return found


def _free_place(distance: float, taken: list[tuple[Array, float]], rng: np.random.Generator) -> Array | None:
    for _ in range(CONSTANTS.max_tries):
        at = rng.uniform(*np.array(CONSTANTS.area))
        if all(np.linalg.norm(at - other) > distance + radius for other, radius in taken):
            return at
    return None


def _obstacle(rng: np.random.Generator) -> dict[str, Any]:
    """Create an obstacle like a person's forearm that moves along the table's far side, over the objects."""
    side, speed = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.05, 0.15))
    z = float(rng.uniform(0.22, 0.30))
    ends = [[0.75, side * 0.40, z], [0.45, side * 0.40, z]]
    return {
        "name": OBSTACLE,
        "shapes": [{"kind": "capsule", "radius": 0.04, "height": 0.20, "rpy": [np.pi / 2, 0.0, 0.0]}],
        "path": [{"t": 0.0, "at": ends[0]}, {"t": 0.30 / speed, "at": ends[1]}],
        "color": (0.85, 0.65, 0.55),
    }


def _settled(scene: Scene) -> Scene:
    """Return the scene with its movable objects at rest."""
    twin = Twin(scene)
    assert twin.follower is not None
    q = np.array(twin.data.qpos[twin.follower.qpos])
    still = np.zeros_like(q)
    for k in range(round(CONSTANTS.settling_time * twin.rate)):
        twin.advance(k / twin.rate, q, still, still, None)
    values = scene.model_dump()
    for item in values["objects"]:
        if item["movable"]:
            body = twin.data.body(OBJECT + item["name"])
            item["at"] = tuple(np.asarray(body.xpos).tolist())
            item["rpy"] = rpy_of(np.asarray(body.xmat).reshape(3, 3))
    return make_scene({**values, "folder": scene.folder})
