"""Sensor effects as logs know them: something that frames pass through, and an account of it in `effects.json`."""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

from splatbot.atomic import atomic_write
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.trajectory import Trajectory

FILE = "effects.json"

# Looked up by name, and only by a log that asks for effects: the core does not depend on the simulator.
_PROVIDER, _MAKE = "splatbot.sim.effects.registry", "make_effects"

Account = dict[str, Any]
"""Of one effect: name, why, settings, frames, ms_per_frame."""


class FrameEffects(Protocol):
    """What the frames of a log go through."""

    def __call__(self, frame: Frame) -> Frame:
        """The frame as the sensor would have given it."""
        ...

    def along(self, path: Trajectory) -> FrameEffects:
        """The same effects for a camera that moves along ``path``."""
        ...

    def kept(self, count: int) -> list[int]:
        """Those of ``count`` frames that arrive."""
        ...

    def report(self) -> list[Account]:
        """The account of each effect."""
        ...

    @property
    def blanks_depth(self) -> bool:
        """Whether a frame may come out without any depth."""
        ...


def make_effects(specs: Sequence[str], *, seed: int) -> FrameEffects:
    """The effects that ``specs`` (`name:option=value,...`) ask for, in their order.

    Raises:
        InputError: an effect or an option is unknown, or a value is out of range.
    """
    make = getattr(importlib.import_module(_PROVIDER), _MAKE)
    return cast(FrameEffects, make(specs, seed=seed))


def write_account(folder: str | Path, *, uri: str, effects: Sequence[Mapping[str, Any]], blanks_depth: bool) -> None:
    """Write `effects.json` into a recording's folder: where its frames came from and what they went through."""
    values = {"uri": uri, "blanks_depth": blanks_depth, "effects": list(effects)}
    with atomic_write(Path(folder) / FILE) as file:
        file.write(json.dumps(values, indent=1, allow_nan=False).encode() + b"\n")


def read_account(folder: str | Path) -> tuple[list[Account], bool]:
    """The accounts in a recording's `effects.json`, and whether its frames may lack any depth; none for a real sensor.

    Raises:
        LogError: the file is damaged.
    """
    path = Path(folder) / FILE
    if not path.exists():
        return [], False
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
        rows, blanks = values["effects"], values.get("blanks_depth", False)
        sound = isinstance(blanks, bool) and all(_is_account(row) for row in rows)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        sound = False
    if not sound:
        raise LogError(
            "is no account of effects.", file=path, field="effects", hint="simulate the log again, or remove the file"
        )
    return rows, blanks


def _is_account(row: Any) -> bool:
    return (
        isinstance(row, dict)
        and all(isinstance(row.get(key), str) for key in ("name", "why"))
        and isinstance(row.get("frames"), int)
        and isinstance(row.get("ms_per_frame"), float | int | None)
    )
