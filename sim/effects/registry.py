"""Sensor effects by name. The module of an effect is imported only when the effect is used."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

from splatbot.errors import InputError
from splatbot.sim.effects.base import Effect, Effects, settings

_CLASSES = {
    "motion_blur": ("splatbot.sim.effects.motion_blur", "MotionBlur"),
    "rolling_shutter": ("splatbot.sim.effects.rolling_shutter", "RollingShutter"),
    "lens_distortion": ("splatbot.sim.effects.lens_distortion", "LensDistortion"),
    "exposure": ("splatbot.sim.effects.exposure", "Exposure"),
    "white_balance": ("splatbot.sim.effects.white_balance", "WhiteBalance"),
    "color_noise": ("splatbot.sim.effects.color_noise", "ColorNoise"),
    "depth_noise": ("splatbot.sim.effects.depth_noise", "DepthNoise"),
    "stereo_holes": ("splatbot.sim.effects.stereo_holes", "StereoHoles"),
    "depth_holes": ("splatbot.sim.effects.depth_holes", "DepthHoles"),
    "blackout": ("splatbot.sim.effects.blackout", "Blackout"),
    "frame_drops": ("splatbot.sim.effects.frame_drops", "FrameDrops"),
    "latency": ("splatbot.sim.effects.latency", "Latency"),
}

EFFECTS = tuple(_CLASSES)
"""Names in the order in which the effects occur in a sensor."""


def effect_class(name: str) -> type[Any]:
    """Return the class of an effect.

    Raises:
        InputError: the name is unknown.
    """
    if name not in _CLASSES:
        raise InputError(f"there is no {name!r}.", field="effect", hint=f"effects: {', '.join(EFFECTS)}")
    module, attribute = _CLASSES[name]
    found: type[Any] = getattr(importlib.import_module(module), attribute)
    return found


def make_effect(spec: str, *, why: str = "") -> Effect:
    """Create the effect of ``spec``: `name`, or `name:option=value,option=value`.

    Args:
        spec: name and settings.
        why: reason for the effect. If empty, it is the spec.

    Raises:
        InputError: the name or an option is unknown, or a value is no number or out of range.
    """
    name, _, text = spec.partition(":")
    kind = effect_class(name.strip())
    known = settings(kind)
    values: dict[str, Any] = {}
    for pair in filter(None, (pair.strip() for pair in text.split(","))):
        key, equals, value = (part.strip() for part in pair.partition("="))
        if key not in known or not equals:
            raise InputError(
                f"{pair!r} is no option of {name}.", field=f"effect {name}", hint=f"write {_written(name, known)}"
            )
        values[key] = _value(name, key, value, type(known[key]))
    try:
        made: Effect = kind(why=why or f"requested as {spec}", **values)
    except InputError as error:
        raise InputError(error.message, field=f"effect {name}: {error.field}", hint=error.hint) from error
    return made


def make_effects(specs: Sequence[str], *, seed: int = 0, why: str = "") -> Effects:
    """Create the effects of several specs in their order; see :func:`make_effect`."""
    return Effects([make_effect(spec, why=why) for spec in specs], seed=seed)


def _value(name: str, key: str, text: str, kind: type) -> Any:
    try:
        if kind is bool:
            return {"true": True, "false": False}[text.lower()]
        return kind(text)
    except (ValueError, KeyError) as error:
        expected = {int: "a whole number", bool: "true or false"}.get(kind, "a number")
        raise InputError(f"is {text!r}.", field=f"effect {name}: {key}", hint=f"give {expected}") from error


def _written(name: str, known: dict[str, Any]) -> str:
    return f"{name}:" + ",".join(f"{key}={value}" for key, value in known.items())
