"""Seeded scenes to pick from, by protocol: isolated, tabletop, packed, bin and shelf."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.protocols import Array
from splatbot.sim.scene import Scene, make_scene
from splatbot.sim.solids import rpy_of
from splatbot.sim.trials.objects import (
    CONVEX,
    HOUSEHOLD,
    TrialObject,
    ball,
    book,
    box,
    can,
    cup,
    household,
    lying,
    mallet,
)
from splatbot.sim.twin import Twin
from splatbot.sim.world import OBJECT

FAMILIES = ("tabletop", "isolated", "packed", "bin", "shelf")
ANY_TARGET = ("packed", "bin", "shelf")
"""Families in which any object may be picked."""
TABLE, OBSTACLE, BIN, SHELF = "table", "obstacle", "bin", "shelf"
SENSOR = ("depth_noise", "depth_holes:share=0.05")
Material = Literal["black", "glass"]


@dataclass(frozen=True)
class ScanViews:
    """Views that a scan passes, from first to last.

    Args:
        rings: [deg] elevation and azimuths of each ring of views.
        target: [m] point that the camera is aimed at.
        distance: [m] from the camera to that point.
    """

    rings: tuple[tuple[float, tuple[int, ...]], ...] = (
        (45.0, (-130, -80, -40, 0, 40, 80)),
        (65.0, (80, 40, 0, -40, -80)),
    )
    target: tuple[float, float, float] = (0.5, 0.0, 0.05)
    distance: float = 0.6


AROUND_TABLE = ScanViews()
"""Views from around the table, with a higher ring on the way back."""


@dataclass(frozen=True)
class SceneConstants:
    """Constants of random trial scenes.

    Args:
        spacing: [m] range of the clearance between objects on a table top and in a shelf.
        packed_spacing: [m] range of it between packed objects.
        mass: [kg] range of an object's mass, log-uniform. The held-out twin multiplies it by 0.5 to 2.5.
        friction: range of an object's friction coefficient. The held-out twin multiplies it by 0.35 to 1.2.
        settling_time: [s] time until all objects are at rest.
        pile_time: [s] the same for objects that fall into a bin.
        moving_period: every n-th table top has a moving obstacle.
        max_tries: largest number of random places of an object.
        special: share of the objects that are black, and of those that are glass.
    """

    spacing: tuple[float, float] = (0.02, 0.05)
    packed_spacing: tuple[float, float] = (0.005, 0.02)
    mass: tuple[float, float] = (0.1, 0.8)
    friction: tuple[float, float] = (0.57, 0.83)
    settling_time: float = 1.5
    pile_time: float = 4.0
    moving_period: int = 5
    max_tries: int = 300
    special: float = 0.1


CONSTANTS = SceneConstants()

Area = tuple[tuple[float, float], tuple[float, float]]
_TABLE_AREA: Area = ((0.36, -0.26), (0.64, 0.26))  # [m] corners of the area with objects
_PACKED_AREA: Area = ((0.42, -0.13), (0.60, 0.13))
_SHELF_AREA: Area = ((0.65, -0.22), (0.75, 0.22))
_BIN_CENTER, _BIN_SIZE, _BIN_WALL = (0.48, 0.0), (0.36, 0.48, 0.07), 0.012  # [m] inside; thickness of the walls
_REACH = ((0.52, 0.0), (0.54, 0.8))  # [m] centre and size of the area in reach
_SHELF_FRONT, _SHELF_SIZE, _SHELF_BOARD = 0.62, (0.26, 0.72, 0.42), 0.018  # [m] x of the front; inside; boards
_FROM_FRONT = ScanViews(
    ((24.0, (130, 150, 180, -150, -130)), (40.0, (-130, -150, 180, 150, 130))), (0.71, 0.0, 0.12), 0.68
)


_COLORS = (
    (0.85, 0.20, 0.18), (0.20, 0.45, 0.85), (0.95, 0.75, 0.15), (0.25, 0.65, 0.35), (0.60, 0.30, 0.70),
    (0.95, 0.50, 0.15), (0.90, 0.90, 0.88), (0.30, 0.75, 0.75),
)  # fmt: skip
_SPECIAL: dict[Material, tuple[float, float, float]] = {"black": (0.05, 0.05, 0.06), "glass": (0.75, 0.82, 0.82)}


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
        others: kinds by name of objects that may be picked instead, if they have a better grasp (:data:`ANY_TARGET`).
        materials: material of each object that a depth camera measures badly.
        viewpoints: of the scan.
    """

    scene: Scene
    target: str
    kind: str
    seed: int
    family: str
    moving: bool
    others: dict[str, str] = field(default_factory=dict)
    materials: dict[str, Material] = field(default_factory=dict)
    viewpoints: ScanViews = AROUND_TABLE


def make_trial(seed: int, family: str = "tabletop") -> TrialScene:
    """Create the scene of a seed; the same seed gives the same scene.

    Physics brings all objects to rest before the scan. The protocols:

    - isolated: one object, of six convex kinds and the household shapes in turn.
    - tabletop: up to seven objects, at least 2 to 5 cm apart, and a moving obstacle in every fifth scene.
    - packed: up to eight objects as they stand, at least 5 to 20 mm apart.
    - bin: up to nine objects that fell into a bin of 36 x 48 x 7 cm.
    - shelf: up to five objects in a shelf with a back, sides and a board above them, open to the robot.

    In the last three, any object may be picked, as in the protocols of VGN (Breyer et al. 2020). Each of their
    objects but the first is black with a probability of 0.1, and glass with the same. Glass is never a target.

    Raises:
        InputError: the family is unknown.
    """
    if family not in FAMILIES:
        raise InputError(f"is {family!r}.", field="scenes", hint=f"one of {', '.join(FAMILIES)}")
    rng = np.random.default_rng((FAMILIES.index(family), seed))
    return _any_target(seed, family, rng) if family in ANY_TARGET else _one_target(seed, family, rng)


def _one_target(seed: int, family: str, rng: np.random.Generator) -> TrialScene:
    items = _isolated(seed, rng) if family == "isolated" else _table_top(rng)
    moving = family == "tabletop" and seed % CONSTANTS.moving_period == CONSTANTS.moving_period - 1
    placed = _placed(items, rng, _TABLE_AREA, CONSTANTS.spacing)
    k = int(rng.choice([k for k, (item, _) in enumerate(placed) if item.fits]))
    values = [value for _, value in placed]
    scene = _scene(f"{family}-{seed}", [*values, _obstacle(rng)] if moving else values)
    settled = _settled(scene, CONSTANTS.settling_time)
    return TrialScene(settled, str(values[k]["name"]), placed[k][0].kind, seed, family, moving)


def _any_target(seed: int, family: str, rng: np.random.Generator) -> TrialScene:
    settling_time, viewpoints = CONSTANTS.settling_time, AROUND_TABLE
    if family == "packed":
        items = [_upright(rng) for _ in range(int(rng.integers(5, 9)))]
        placed, fixed = _placed(items, rng, _PACKED_AREA, CONSTANTS.packed_spacing), []
    elif family == "bin":
        settling_time = CONSTANTS.pile_time
        placed, fixed = _dropped([_any(rng) for _ in range(int(rng.integers(6, 10)))], rng), [_bin()]
    else:
        viewpoints = _FROM_FRONT
        items = [_any(rng) for _ in range(int(rng.integers(3, 6)))]
        placed, fixed = _placed(items, rng, _SHELF_AREA, CONSTANTS.spacing), [_shelf()]
    materials = _special(placed, rng)
    scene = _scene(f"{family}-{seed}", [value for _, value in placed] + fixed)
    settled = _without_lost(_settled(scene, settling_time))
    kept = {obj.name for obj in settled.movable}
    kinds = {str(value["name"]): item.kind for item, value in placed if value["name"] in kept}
    if all(materials.get(name) == "glass" for name in kinds):
        materials.pop(next(iter(kinds)))  # one object remains to be picked
    candidates = {name: kind for name, kind in kinds.items() if materials.get(name) != "glass"}
    first = str(rng.choice(list(candidates)))
    others = {name: kind for name, kind in candidates.items() if name != first}
    return TrialScene(settled, first, kinds[first], seed, family, False, others, materials, viewpoints)


def _scene(name: str, objects: list[dict[str, Any]]) -> Scene:
    table = {"name": TABLE, "shapes": [{"kind": "plane"}], "color": [0.55, 0.45, 0.35]}
    return make_scene(
        {
            "name": name,
            "objects": [table, *objects],
            "camera": {"at": [1.25, -0.85, 0.75], "look_at": [0.45, 0.0, 0.12], "sensor": SENSOR},
            "task": {"kind": "grasp"},
        }
    )


def _isolated(seed: int, rng: np.random.Generator) -> list[TrialObject]:
    k = seed % (len(CONVEX) + len(HOUSEHOLD))
    return [CONVEX[k](rng) if k < len(CONVEX) else household(list(HOUSEHOLD)[k - len(CONVEX)], rng)]


def _table_top(rng: np.random.Generator) -> list[TrialObject]:
    items = [cup(rng), mallet(rng), can(rng), box(rng)]
    more = [cup, mallet, ball, book, box, lying]
    chosen = rng.choice(len(more), int(rng.integers(1, 4)), replace=False)
    return items + [more[k](rng) for k in chosen]


def _any(rng: np.random.Generator) -> TrialObject:
    """Return a household shape in two of three cases, else a convex object."""
    if rng.random() < 2 / 3:
        return household(str(rng.choice(list(HOUSEHOLD))), rng)
    return CONVEX[int(rng.integers(len(CONVEX)))](rng)


_UPRIGHT = ("bottle", "mug", "spray bottle", "drill", "pear", "bear", "camera", "house")


def _upright(rng: np.random.Generator) -> TrialObject:
    """Return an object that stands, as in the packed scenes of VGN."""
    if rng.random() < 0.5:
        return household(str(rng.choice(_UPRIGHT)), rng)
    return (can, box, cup)[int(rng.integers(3))](rng)


Placed = list[tuple[TrialObject, dict[str, Any]]]


def _placed(items: list[TrialObject], rng: np.random.Generator, area: Area, spacing: tuple[float, float]) -> Placed:
    """Place objects at random without overlap; an object without a free place is left out."""
    taken: list[tuple[Array, float]] = []
    found: Placed = []
    colors = rng.permutation(len(_COLORS))
    for k, item in enumerate(items):
        apart = float(rng.uniform(*spacing))
        at = _free_place(item.radius + apart, taken, rng, area)
        if at is None:
            continue
        taken.append((at, item.radius))
        turn = [0.0, 0.0, float(rng.uniform(-np.pi, np.pi))]
        found.append((item, _object(item, k, [*at.tolist(), item.height + 5e-4], turn, colors, rng)))
    return found


def _dropped(items: list[TrialObject], rng: np.random.Generator) -> Placed:
    """Place objects above the bin, one above the other, in random orientations."""
    found: Placed = []
    colors = rng.permutation(len(_COLORS))
    z = 0.02
    for k, item in enumerate(items):
        reach = float(np.hypot(item.radius, item.height))
        free = np.maximum(np.array(_BIN_SIZE[:2]) / 2 - reach, 0.0)
        at = np.array(_BIN_CENTER) + rng.uniform(-free, free)
        turn = [float(x) for x in rng.uniform(-np.pi, np.pi, 3)]
        found.append((item, _object(item, k, [*at.tolist(), z + reach], turn, colors, rng)))
        z += 2 * reach
    return found


def _object(
    item: TrialObject, k: int, at: list[float], rpy: list[float], colors: NDArray[np.int64], rng: np.random.Generator
) -> dict[str, Any]:
    return {
        "name": f"{item.kind.replace(' ', '-')}-{k}",
        "shapes": item.shapes,
        "at": at,
        "rpy": rpy,
        "movable": True,
        "mass": float(np.exp(rng.uniform(*np.log(CONSTANTS.mass)))),
        "friction": float(rng.uniform(*CONSTANTS.friction)),
        "color": _COLORS[int(colors[k % len(_COLORS)])],
    }


def _special(placed: Placed, rng: np.random.Generator) -> dict[str, Material]:
    """Make a share of the objects black and of glass, all but the first, and return their materials by name."""
    found: dict[str, Material] = {}
    for _, value in placed[1:]:
        draw = float(rng.random())
        if draw < 2 * CONSTANTS.special:
            material: Material = "black" if draw < CONSTANTS.special else "glass"
            found[str(value["name"])] = material
            value["color"] = _SPECIAL[material]
    return found


def _bin() -> dict[str, Any]:
    (cx, cy), (x, y, z), wall = _BIN_CENTER, _BIN_SIZE, _BIN_WALL
    walls = [([wall, y + 2 * wall, z], [side * (x + wall) / 2, 0.0, z / 2]) for side in (-1.0, 1.0)]
    walls += [([x, wall, z], [0.0, side * (y + wall) / 2, z / 2]) for side in (-1.0, 1.0)]
    shapes = [{"kind": "box", "size": size, "at": at} for size, at in walls]
    return {"name": BIN, "shapes": shapes, "at": [cx, cy, 0.0], "color": (0.45, 0.55, 0.65)}


def _shelf() -> dict[str, Any]:
    (x, y, z), board = _SHELF_SIZE, _SHELF_BOARD
    boards = [
        ([x, y, board], [x / 2, 0.0, z + board / 2]),
        ([board, y, z + board], [x + board / 2, 0.0, (z + board) / 2]),
    ]
    boards += [([x, board, z + board], [x / 2, side * (y + board) / 2, (z + board) / 2]) for side in (-1.0, 1.0)]
    shapes = [{"kind": "box", "size": size, "at": at} for size, at in boards]
    return {"name": SHELF, "shapes": shapes, "at": [_SHELF_FRONT, 0.0, 0.0], "color": (0.70, 0.62, 0.48)}


def _free_place(
    distance: float, taken: list[tuple[Array, float]], rng: np.random.Generator, area: Area
) -> Array | None:
    for _ in range(CONSTANTS.max_tries):
        at = rng.uniform(*np.array(area))
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


def _settled(scene: Scene, seconds: float) -> Scene:
    """Return the scene with its movable objects as they are at rest after some time, without the robot in their way."""
    values = scene.model_dump()
    alone = {**values, "robot": None, "task": {"kind": "none"}, "folder": scene.folder}
    twin = Twin(make_scene(alone))
    none = np.zeros(0)
    for k in range(round(seconds * twin.rate)):
        twin.advance(k / twin.rate, none, none, none, None)
    for item in values["objects"]:
        if item["movable"]:
            body = twin.data.body(OBJECT + item["name"])
            item["at"] = tuple(np.asarray(body.xpos).tolist())
            item["rpy"] = rpy_of(np.asarray(body.xmat).reshape(3, 3))
    return make_scene({**values, "folder": scene.folder})


def _without_lost(scene: Scene) -> Scene:
    """Return the scene without movable objects that are not in the bin, or out of the robot's reach."""
    center, size = (_BIN_CENTER, _BIN_SIZE) if any(obj.name == BIN for obj in scene.objects) else _REACH
    values = scene.model_dump()
    values["objects"] = [
        item
        for item in values["objects"]
        if not item["movable"] or (np.abs(np.subtract(item["at"][:2], center)) <= np.array(size[:2]) / 2).all()
    ]
    return make_scene({**values, "folder": scene.folder})
