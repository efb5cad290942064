"""Interface of simulated sensor effects, and their records in `effects.json`."""

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

# The simulator is imported by name and only for logs with effects, so that the core does not depend on it.
_PROVIDER, _MAKE = "splatbot.sim.effects.registry", "make_effects"

Account = dict[str, Any]
"""Record of one effect with the keys name, why, settings, frames and ms_per_frame."""


class FrameEffects(Protocol):
    """A chain of sensor effects that is applied to the frames of a log."""

    def __call__(self, frame: Frame) -> Frame:
        """Apply the effects to an ideal frame."""
        ...

    def along(self, path: Trajectory) -> FrameEffects:
        """Return the same effects for a camera that moves along ``path``."""
        ...

    def kept(self, count: int) -> list[int]:
        """Return the indices of the frames out of ``count`` that are not dropped."""
        ...

    def report(self) -> list[Account]:
        """Return the record of each effect."""
        ...

    @property
    def blanks_depth(self) -> bool:
        """Return whether the effects may remove all depth of a frame."""
        ...


def make_effects(specs: Sequence[str], *, seed: int) -> FrameEffects:
    """Create the effects of ``specs`` (`name:option=value,...`) in their order.

    Raises:
        InputError: an effect or an option is unknown, or a value is out of range.
    """
    make = getattr(importlib.import_module(_PROVIDER), _MAKE)
    return cast(FrameEffects, make(specs, seed=seed))


def write_account(folder: str | Path, *, uri: str, effects: Sequence[Mapping[str, Any]], blanks_depth: bool) -> None:
    """Write `effects.json` into a recording's folder: the source of the frames and the applied effects."""
    values = {"uri": uri, "blanks_depth": blanks_depth, "effects": list(effects)}
    with atomic_write(Path(folder) / FILE) as file:
        file.write(json.dumps(values, indent=1, allow_nan=False).encode() + b"\n")


def read_account(folder: str | Path) -> tuple[list[Account], bool]:
    """Read the records of a recording's `effects.json`, and whether its frames may have no depth.

    Without the file, as for a real sensor, there are no records.

    Raises:
        LogError: the file is damaged.
    """
    path = Path(folder) / FILE
    if not path.exists():
        return [], False
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
        rows, blanks = values["effects"], values.get("blanks_depth", False)
        valid = isinstance(blanks, bool) and all(_is_account(row) for row in rows)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        valid = False
    if not valid:
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
