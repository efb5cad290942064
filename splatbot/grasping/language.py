"""Rule-based language queries: names, colours, shapes, sizes and spatial relations. The vocabulary is closed."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import AffordanceError, NameHint, OneKindAffordance, Target
from splatbot.grasping.spatial import at_point
from splatbot.protocols import Array
from splatbot.segmentation import MapObject, SegmentedMap, primitive_fits

COLORS = {
    "red": (0.75, 0.12, 0.12),
    "orange": (0.90, 0.50, 0.10),
    "yellow": (0.90, 0.80, 0.20),
    "green": (0.20, 0.60, 0.25),
    "cyan": (0.25, 0.70, 0.75),
    "blue": (0.15, 0.30, 0.75),
    "purple": (0.50, 0.20, 0.60),
    "pink": (0.95, 0.60, 0.70),
    "brown": (0.45, 0.30, 0.15),
    "black": (0.08, 0.08, 0.08),
    "grey": (0.50, 0.50, 0.50),
    "white": (0.92, 0.92, 0.92),
}
SHAPES = {
    "box": ("box", "cube", "carton", "block", "brick", "book", "packet"),
    "cylinder": ("cylinder", "can", "cup", "mug", "bottle", "roll", "tape", "tube", "jar", "tin"),
    "sphere": ("sphere", "ball", "orb", "fruit"),
}
SIZES = ("largest", "biggest", "smallest", "tallest", "lowest", "widest", "thinnest", "nearest", "closest", "farthest")
EXTENTS = {
    "cup": ((0.04, 0.16), (0.04, 0.16)),
    "mug": ((0.06, 0.16), (0.05, 0.18)),
    "can": ((0.05, 0.25), (0.04, 0.16)),
    "tin": ((0.02, 0.25), (0.04, 0.25)),
    "jar": ((0.05, 0.30), (0.03, 0.20)),
    "bottle": ((0.08, 0.45), (0.03, 0.20)),
    "tube": ((0.01, 0.60), (0.01, 0.60)),
    "ball": ((0.02, 0.35), (0.02, 0.35)),
    "fruit": ((0.02, 0.30), (0.02, 0.35)),
    "cube": ((0.01, 0.35), (0.01, 0.35)),
    "box": ((0.012, 0.50), (0.01, 0.60)),
    "carton": ((0.02, 0.50), (0.02, 0.60)),
    "block": ((0.012, 0.35), (0.01, 0.35)),
    "brick": ((0.012, 0.35), (0.01, 0.35)),
}
"""Usual heights and horizontal extents [m] by noun; a flat patch has those of no cup."""
STRUCTURE = "structure"
"""Label of a piece of a wall, post or table; see :mod:`splatbot.grasping.structure`."""
RELATIONS = ("left of", "right of", "in front of", "behind", "next to", "near")
_GENERIC = ("thing", "object", "one", "item", "something")
_STOP_WORDS = (
    "the",
    "a",
    "an",
    "that",
    "is",
    "most",
    "please",
    "grasp",
    "pick",
    "up",
    "take",
    "to",
    "colored",
    "coloured",
)
_SYNONYMS = {"gray": "grey", "violet": "purple", "magenta": "pink", "turquoise": "cyan", "teal": "cyan", "big": "large"}


@dataclass(frozen=True)
class QueryConstants:
    """Constants of scores of language queries."""

    color_scale: float = 28.0
    """CIELAB distance [1] at which the colour score falls to exp(-1/2). A larger one accepts more distant shades."""
    shape_scale: float = 2.5e-3
    """Excess error [m] of a fit at which the shape score falls to exp(-1). A larger one separates similar shapes less
    strictly."""
    flat_height: float = 0.012
    """Height [m] below which an object is a flat patch. A larger one takes thin objects for patches."""
    extent_scale: float = 0.01
    """Excess [m] of an extent at which the score of a noun falls to exp(-1). A larger one accepts other sizes."""
    min_score: float = 0.3
    """Smallest score [1] of a match. A larger one refuses more queries as unknown."""
    tie_ratio: float = 0.75
    """Ratio [1] of the second score to the best above which a query is ambiguous. A larger one decides more close
    cases."""


CONSTANTS = QueryConstants()


@dataclass(frozen=True, eq=False)
class _ObjectAttributes:
    """Attributes of the objects of a scene; ``centers`` (K, 3) are in the robot's base frame [m]."""

    scene: SegmentedMap
    centers: Array

    @classmethod
    def of(cls, scene: SegmentedMap) -> _ObjectAttributes:
        centers = np.array([o.center for o in scene.objects]).reshape(-1, 3)
        return cls(scene, transform_points(inverse(scene.T_world_base), centers))


class LanguageAffordance(OneKindAffordance[NameHint]):
    """Finds objects by names and aliases of the scene file, else by rules on colour, shape, size and relation."""

    name = "rules"
    kind, wanted = NameHint, "words"

    def _find(self, hint: NameHint, scene: SegmentedMap) -> Target:
        text = " ".join(re.findall(r"[a-z0-9_-]+", hint.text.lower()))
        if not text:
            raise InputError("is empty.", field="target", hint='give a name, or "red box"')
        named = _named(scene, text)
        if named is not None:
            return named
        if not scene.objects:
            raise AffordanceError("is not there: no object stands out of the map.", field=text, hint="point at a place")
        scores, notes = _scores(_ObjectAttributes.of(scene), text)
        return _decided(scene, text, scores, notes)


def _named(scene: SegmentedMap, text: str) -> Target | None:
    """Return the object with this name or alias in the scene file; None if no entry has it."""
    plain = " ".join(word for word in text.split() if word not in _STOP_WORDS)
    numbered = re.fullmatch(r"(.+) (\d+)", plain)
    if numbered and int(numbered[2]) < len(scene.objects):
        item = scene.objects[int(numbered[2])]
        if plain in (f"object {item.number}", label_of(scene, item)):
            return Target(item.rows, None, item.name or plain, "list", 1.0, (), item.number)
    for entry in scene.names:
        if plain in (other.lower() for other in (entry.name, *entry.aliases)):
            found = next((o for o in scene.objects if o.name == entry.name), None)
            if found is None:
                return at_point(scene, entry.at, backend="scene", label=entry.name)
            return Target(found.rows, None, entry.name, "scene", 1.0, (), found.number)
    return None


def _decided(scene: SegmentedMap, text: str, scores: Array, notes: tuple[str, ...]) -> Target:
    order = np.argsort(-scores, kind="stable")
    best = int(order[0])
    described = [f"{_described(scene.objects[k])}: {scores[k]:.2f}" for k in order[:4]]
    if scores[best] < CONSTANTS.min_score:
        raise AffordanceError(
            f"fits none of {len(scores)} objects; the nearest are {'; '.join(described)}.",
            field=text,
            hint="use other words, or point at it",
            candidates=tuple(described),
        )
    like = [k for k in order if scores[k] > CONSTANTS.tie_ratio * scores[best]]
    superlative = any(word in SIZES for word in text.split())
    if superlative and len(like) > 1:  # "largest" takes the largest, with a note on others of nearly that size
        rivals = "; ".join(_described(scene.objects[k]) for k in like[1:])
        notes = (*notes, f"took {_described(scene.objects[best])}; nearly equal: {rivals}")
    elif len(like) > 1:
        raise AffordanceError(
            f"fits {len(like)} objects about equally: {'; '.join(described[: len(like)])}.",
            field=text,
            hint="say more, as left of or largest, or point at it",
            candidates=tuple(described[: len(like)]),
        )
    found = scene.objects[best]
    fitting = (note for note, k in zip(described, order, strict=False) if scores[k] > 0.0)
    return Target(found.rows, None, found.name or text, "rules", float(scores[best]), (*notes, *fitting), best)


def color_name(item: MapObject) -> str:
    """Return the name of the colour nearest to that of an object."""
    return min(COLORS, key=lambda name: float(np.linalg.norm(_lab(item.color[None]) - _lab(np.array([COLORS[name]])))))


def shape_name(scene: SegmentedMap, item: MapObject) -> str:
    """Return "patch" for a flat object, else the name of the primitive that fits it best."""
    if item.size[2] < CONSTANTS.flat_height:
        return "patch"
    return max(SHAPES, key=lambda kind: _shape_score(scene, item, kind))


def label_of(scene: SegmentedMap, item: MapObject) -> str:
    """Return the name of an object in the scene file, else its colour, shape and number, which names it as a target.

    Structure has no shape of its own, and is called so.
    """
    if item.number in scene.structures and not item.name:
        return f"{STRUCTURE} {item.number}"
    return item.name or f"{color_name(item)} {shape_name(scene, item)} {item.number}"


def _described(item: MapObject) -> str:
    """Describe an object by its name, the nearest colour name and its size."""
    color = color_name(item)
    size = " x ".join(f"{100 * x:.0f}" for x in item.size)
    return f"{item.name or f'object {item.number}'} ({color}, {size} cm)"


def _scores(attributes: _ObjectAttributes, text: str) -> tuple[Array, tuple[str, ...]]:
    """Return the scores (K,) of the objects, 0..1, and a note on the applied rules."""
    scores = np.ones(len(attributes.scene.objects))
    scores[list(attributes.scene.structures)] = 0.0  # only their labels name them
    notes: list[str] = []
    for relation in RELATIONS:
        if f" {relation} " in f" {text} ":
            text, _, other = text.partition(relation)
            scores = scores * _relation_scores(attributes, relation, other.strip())
            notes.append(relation)
            break
    best_of: list[str] = []
    for raw in text.split():
        word = _SYNONYMS.get(raw, raw)
        if word in _STOP_WORDS or word in _GENERIC:
            continue
        if word in SIZES:
            best_of.append(word)
            continue
        if word.isdigit():  # labels are printed with numbers: "grey box 27"
            scores = scores * np.array([float(item.number == int(word)) for item in attributes.scene.objects])
            continue
        rule = _rule(word)
        if rule is None:
            known = ", ".join((*COLORS, *(w for words in SHAPES.values() for w in words), *SIZES, *RELATIONS))
            ways = "name it in scene.yaml, point at it, write a label of `splatbot objects`, or use"
            raise AffordanceError(
                f"has {raw!r}, which is neither a name of the scene nor in the vocabulary.",
                field=text.strip() or raw,
                hint=f"{ways}: {known}",
            )
        scores = scores * rule(attributes)
        notes.append(word)
    for word in best_of:  # "largest red" selects the largest of the red objects, not the reddest of the large ones
        scores = np.where(
            scores >= CONSTANTS.min_score,
            scores * _superlative_scores(attributes, word, scores >= CONSTANTS.min_score),
            0.0,
        )
        notes.append(word)
    return scores, (f"rules: {', '.join(notes) or 'any'}",)


def _rule(word: str) -> Callable[[_ObjectAttributes], Array] | None:
    if word in COLORS:
        return lambda attributes: _color_scores(attributes, word)
    for kind, words in SHAPES.items():
        if word in words or word.removesuffix("s") in words:
            thing = word if word in words else word.removesuffix("s")
            return lambda attributes: np.array(
                [_shape_score(attributes.scene, o, kind) * _extent_score(o, thing) for o in attributes.scene.objects]
            )
    if word in ("large", "small", "tall", "flat"):
        return lambda attributes: _size_scores(attributes, word)
    return None


def _color_scores(attributes: _ObjectAttributes, word: str) -> Array:
    away = np.linalg.norm(
        _lab(np.array([o.color for o in attributes.scene.objects])) - _lab(np.array([COLORS[word]])), axis=1
    )
    return np.asarray(np.exp(-0.5 * (away / CONSTANTS.color_scale) ** 2))


def _lab(rgb: Array) -> Array:
    """Convert colours (K, 3) to CIELAB with halved lightness, since lightness depends on the illumination."""
    lab = cv2.cvtColor(rgb.astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0].astype(np.float64)
    return lab * [0.5, 1.0, 1.0]


def _shape_score(scene: SegmentedMap, item: MapObject, kind: str) -> float:
    points = scene.points[item.rows]
    support = scene.under(points)
    fits = {
        f.shape["kind"]: f.error for f in primitive_fits(points, support.offset if support is not None else -np.inf)
    }
    return float(np.exp(-(fits[kind] - min(fits.values())) / CONSTANTS.shape_scale))


def _extent_score(item: MapObject, thing: str) -> float:
    """Return 1 for an object with the usual extents of a noun; the score falls with the excess."""
    if thing not in EXTENTS:
        return 1.0
    (low, high), (narrow, wide) = EXTENTS[thing]
    long, short, height = item.size
    excess = max(low - height, height - high, narrow - short, long - wide, 0.0)
    return float(np.exp(-excess / CONSTANTS.extent_scale))


def _size_scores(attributes: _ObjectAttributes, word: str) -> Array:
    values = _measure(attributes, {"large": "largest", "small": "smallest", "tall": "tallest", "flat": "lowest"}[word])
    middle = np.median(values)
    return np.asarray(1.0 / (1.0 + np.exp(-4.0 * (values - middle) / max(abs(middle), 1e-6))))


def _superlative_scores(attributes: _ObjectAttributes, word: str, among: NDArray[np.bool_]) -> Array:
    """Score objects (K,) by a superlative: 1 for the best of ``among``, decreasing with the distance from it."""
    if not among.any():
        return np.zeros(len(among))
    values = _measure(attributes, word)
    best = values[among].max()
    return np.asarray(np.exp(-(best - values) / (0.2 * max(abs(best), 1e-6))))


def _measure(attributes: _ObjectAttributes, word: str) -> Array:
    sizes = np.array([o.size for o in attributes.scene.objects])
    away = np.linalg.norm(attributes.centers[:, :2], axis=1)
    volume = np.cbrt(np.maximum(sizes, 1e-3).prod(axis=1))
    return {
        "largest": volume,
        "biggest": volume,
        "smallest": -volume,
        "tallest": sizes[:, 2],
        "lowest": -sizes[:, 2],
        "widest": sizes[:, 0],
        "thinnest": -sizes.min(axis=1),
        "nearest": -away,
        "closest": -away,
        "farthest": away,
    }[word]


def _relation_scores(attributes: _ObjectAttributes, relation: str, other: str) -> Array:
    """Score objects (K,) by a relation to another object in the robot's base frame: x forward, y to the left."""
    named = _named(attributes.scene, other)
    if named is None:
        scores, _ = _scores(attributes, other)
        named = _decided(attributes.scene, other, scores, ())
    at = transform_points(
        inverse(attributes.scene.T_world_base), attributes.scene.model.means[named.rows].double().numpy()
    )
    by = attributes.centers - np.median(at, axis=0)
    ahead, left = by[:, 0], by[:, 1]
    away = np.linalg.norm(by[:, :2], axis=1)
    toward = {"left of": left, "right of": -left, "behind": ahead, "in front of": -ahead}
    score = np.exp(-away / 0.2)
    if relation in toward:
        share = toward[relation] / np.maximum(away, 1e-6)
        score = np.where(share > 0.5, 0.5 + 0.5 * score, 0.0)
    if named.number >= 0:
        score[named.number] = 0.0
    return np.asarray(score)
