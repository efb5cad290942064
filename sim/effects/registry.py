"""Sensor effects by name. The module of an effect is imported only when the effect is used."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

from splatbot.errors import InputError
from splatbot.sim.effects.base import Effects, SensorEffect, settings

EFFECTS = (
    "motion_blur",
    "rolling_shutter",
    "depth_camera",
    "lens_distortion",
    "exposure",
    "white_balance",
    "color_noise",
    "depth_noise",
    "stereo_holes",
    "depth_holes",
    "blackout",
    "frame_drops",
    "latency",
)
"""Names in the order in which the effects occur in a sensor; each is a module of this package with one class.

The class of the module ``motion_blur`` is ``MotionBlur``.
"""


def effect_class(name: str) -> type[SensorEffect]:
    """Return the class of an effect.

    Raises:
        InputError: the name is unknown.
    """
    if name not in EFFECTS:
        raise InputError(f"there is no {name!r}.", field="effect", hint=f"effects: {', '.join(EFFECTS)}")
    module = importlib.import_module(f"splatbot.sim.effects.{name}")
    found: type[SensorEffect] = getattr(module, name.title().replace("_", ""))
    return found


def make_effect(spec: str, *, why: str = "") -> SensorEffect:
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
        return kind(why=why or f"requested as {spec}", **values)
    except InputError as error:
        raise InputError(error.message, field=f"effect {name}: {error.field}", hint=error.hint) from error


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
