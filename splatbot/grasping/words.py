"""Targets from words by rules: names of a scene file, colours, shapes, sizes and places. No open vocabulary."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import AffordanceError, Hint, NameHint, Target
from splatbot.grasping.places import at_point
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
PLACES = ("left of", "right of", "in front of", "behind", "next to", "near")
_ANY = ("thing", "object", "one", "item", "something")
_SKIPPED = (
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
_SAME = {"gray": "grey", "violet": "purple", "magenta": "pink", "turquoise": "cyan", "teal": "cyan", "big": "large"}
_OFF = 28.0  # of CIELAB by which a colour is another
_BEND = 2.5e-3  # [m] of a shape's error by which it is another
_LEAST, _TIE = 0.3, 0.75  # score of what is found at all; share of the best that a second must not have


@dataclass(frozen=True, eq=False)
class _ObjectLooks:
    """What rules can say of the objects of a scene, each (K,) or by name."""

    scene: SegmentedMap
    centers: Array

    @classmethod
    def of(cls, scene: SegmentedMap) -> _ObjectLooks:
        centers = np.array([o.center for o in scene.objects]).reshape(-1, 3)
        return cls(scene, transform_points(inverse(scene.T_world_base), centers))


class WordAffordance:
    """Names and aliases of the scene file; else rules on colour, shape, size and place of segmented objects."""

    @property
    def name(self) -> str:
        """As results tell it."""
        return "rules"

    def understands(self, hint: Hint) -> bool:
        """Words."""
        return isinstance(hint, NameHint)

    def locate(self, hint: Hint, scene: SegmentedMap) -> Target:
        """See :class:`splatbot.grasping.affordance.Affordance`."""
        if not isinstance(hint, NameHint):
            raise InputError(f"is a {type(hint).__name__}.", field="hint", hint="give words")
        text = " ".join(re.findall(r"[a-z0-9_-]+", hint.text.lower()))
        if not text:
            raise InputError("is empty.", field="target", hint='give a name, or "red box"')
        named = _named(scene, text)
        if named is not None:
            return named
        if not scene.objects:
            raise AffordanceError("is not there: no object stands out of the map.", field=text, hint="point at a place")
        scores, notes = _scores(_ObjectLooks.of(scene), text)
        return _decided(scene, text, scores, notes)


def _named(scene: SegmentedMap, text: str) -> Target | None:
    """What a scene file calls so; None if it calls nothing so."""
    plain = " ".join(word for word in text.split() if word not in _SKIPPED)
    for place in scene.names:
        if plain in (other.lower() for other in (place.name, *place.aliases)):
            found = next((o for o in scene.objects if o.name == place.name), None)
            if found is None:
                return at_point(scene, place.at, backend="scene", label=place.name)
            return Target(found.rows, None, place.name, "scene", 1.0, (), found.number)
    return None


def _decided(scene: SegmentedMap, text: str, scores: Array, notes: tuple[str, ...]) -> Target:
    order = np.argsort(-scores, kind="stable")
    best = int(order[0])
    told = [f"{_told(scene.objects[k])}: {scores[k]:.2f}" for k in order[:4]]
    if scores[best] < _LEAST:
        raise AffordanceError(
            f"fits none of {len(scores)} objects; the nearest are {'; '.join(told)}.",
            field=text,
            hint="use other words, or point at it",
            candidates=tuple(told),
        )
    like = [k for k in order if scores[k] > _TIE * scores[best]]
    if len(like) > 1:
        raise AffordanceError(
            f"fits {len(like)} objects about equally: {'; '.join(told[: len(like)])}.",
            field=text,
            hint="say more, as left of or largest, or point at it",
            candidates=tuple(told[: len(like)]),
        )
    found = scene.objects[best]
    return Target(found.rows, None, found.name or text, "rules", float(scores[best]), (*notes, *told), best)


def _told(thing: MapObject) -> str:
    """An object in words, by the nearest colour and its size."""
    color = min(
        COLORS, key=lambda name: float(np.linalg.norm(_lab(thing.color[None]) - _lab(np.array([COLORS[name]]))))
    )
    size = " x ".join(f"{100 * x:.0f}" for x in thing.size)
    return f"{thing.name or f'object {thing.number}'} ({color}, {size} cm)"


def _scores(looks: _ObjectLooks, text: str) -> tuple[Array, tuple[str, ...]]:
    """How well the words fit each object (K,), 0..1, and which rules were used."""
    scores = np.ones(len(looks.scene.objects))
    notes: list[str] = []
    for place in PLACES:
        if f" {place} " in f" {text} ":
            text, _, other = text.partition(place)
            scores = scores * _placed(looks, place, other.strip())
            notes.append(place)
            break
    best_of: list[str] = []
    for raw in text.split():
        word = _SAME.get(raw, raw)
        if word in _SKIPPED or word in _ANY:
            continue
        if word in SIZES:
            best_of.append(word)
            continue
        rule = _rule(word)
        if rule is None:
            known = ", ".join((*COLORS, *(w for words in SHAPES.values() for w in words), *SIZES, *PLACES))
            raise AffordanceError(
                f"has {raw!r}, which is no name of the scene and no word of the rules.",
                field=text.strip() or raw,
                hint=f"name it in scene.yaml, point at it, or use: {known}",
            )
        scores = scores * rule(looks)
        notes.append(word)
    for word in best_of:  # the largest of those that are red, not the reddest of the large
        scores = np.where(scores >= _LEAST, scores * _ranked(looks, word, scores >= _LEAST), 0.0)
        notes.append(word)
    return scores, (f"rules: {', '.join(notes) or 'any'}",)


def _rule(word: str) -> Callable[[_ObjectLooks], Array] | None:
    if word in COLORS:
        return lambda looks: _colored(looks, word)
    for kind, words in SHAPES.items():
        if word in words or word.removesuffix("s") in words:
            return lambda looks: np.array([_shaped(looks.scene, o, kind) for o in looks.scene.objects])
    if word in ("large", "small", "tall", "flat"):
        return lambda looks: _sized(looks, word)
    return None


def _colored(looks: _ObjectLooks, word: str) -> Array:
    away = np.linalg.norm(
        _lab(np.array([o.color for o in looks.scene.objects])) - _lab(np.array([COLORS[word]])), axis=1
    )
    return np.asarray(np.exp(-0.5 * (away / _OFF) ** 2))


def _lab(rgb: Array) -> Array:
    """CIELAB (K, 3), lightness halved: it changes with the light."""
    lab = cv2.cvtColor(rgb.astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0].astype(np.float64)
    return lab * [0.5, 1.0, 1.0]


def _shaped(scene: SegmentedMap, thing: MapObject, kind: str) -> float:
    points = scene.points[thing.rows]
    support = scene.under(points)
    fits = {
        f.shape["kind"]: f.error for f in primitive_fits(points, support.offset if support is not None else -np.inf)
    }
    return float(np.exp(-(fits[kind] - min(fits.values())) / _BEND))


def _sized(looks: _ObjectLooks, word: str) -> Array:
    values = _measure(looks, {"large": "largest", "small": "smallest", "tall": "tallest", "flat": "lowest"}[word])
    middle = np.median(values)
    return np.asarray(1.0 / (1.0 + np.exp(-4.0 * (values - middle) / max(abs(middle), 1e-6))))


def _ranked(looks: _ObjectLooks, word: str, among: NDArray[np.bool_]) -> Array:
    """1 for the first of those that still count, less by how far others are behind."""
    values = _measure(looks, word)
    best = values[among].max() if among.any() else 0.0
    return np.asarray(np.exp(-(best - values) / (0.2 * max(abs(best), 1e-6))))


def _measure(looks: _ObjectLooks, word: str) -> Array:
    sizes = np.array([o.size for o in looks.scene.objects])
    away = np.linalg.norm(looks.centers[:, :2], axis=1)
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


def _placed(looks: _ObjectLooks, place: str, other: str) -> Array:
    """As the robot sees it: x is ahead, y to its left."""
    named = _named(looks.scene, other)
    if named is None:
        scores, _ = _scores(looks, other)
        named = _decided(looks.scene, other, scores, ())
    at = transform_points(inverse(looks.scene.T_world_base), looks.scene.model.means[named.rows].double().numpy())
    by = looks.centers - np.median(at, axis=0)
    ahead, left = by[:, 0], by[:, 1]
    away = np.linalg.norm(by[:, :2], axis=1)
    toward = {"left of": left, "right of": -left, "behind": ahead, "in front of": -ahead}
    score = np.exp(-away / 0.2)
    if place in toward:
        share = toward[place] / np.maximum(away, 1e-6)
        score = np.where(share > 0.5, 0.5 + 0.5 * score, 0.0)
    if named.number >= 0:
        score[named.number] = 0.0
    return np.asarray(score)
