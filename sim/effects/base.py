"""Base class of sensor effects, and the sequence of effects of a run with its cost."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, Self, TypeVar

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.declaration import DeclaredEffect
from splatbot.trajectory import Trajectory

T = TypeVar("T", int, float)

Observable = Literal["colors", "depth", "stamps", "arrivals"]
"""Property of a frame stream that an effect changes."""

# Fields of an effect's dataclass that are no settings: the reason for it, and the camera path.
_NO_SETTINGS = ("why", "path")


@dataclass(frozen=True)
class SettingRange:
    """Range of a number: finite, from ``low`` to ``high``, both included, and less than ``below``."""

    low: float
    high: float
    below: float
    hint: str

    def check(self, name: str, value: float) -> None:
        """Check the value of the setting ``name``.

        Raises:
            InputError: the value is out of range.
        """
        if not (np.isfinite(value) and self.low <= value <= self.high and value < self.below):
            raise InputError(f"is {value}.", field=name, hint=self.hint)


def setting(
    default: T,
    hint: str = "give a finite number",
    *,
    low: float = -np.inf,
    high: float = np.inf,
    below: float = np.inf,
) -> T:
    """Declare a numeric field of an effect with the range of its finite values.

    Args:
        default: default value.
        hint: description of the range in an error.
        low: least value.
        high: greatest value.
        below: number that every value is less than.
    """
    declared: T = field(default=default, metadata={"range": SettingRange(low, high, below, hint)})
    return declared


@dataclass(frozen=True, kw_only=True)
class SensorEffect(DeclaredEffect):
    """Simulated deviation of a real sensor from an ideal frame; a subclass is a frozen dataclass of its settings.

    ``cost`` describes the computation per frame, and ``observable`` is the property of the frames that changes. The
    ranges of the fields that :func:`setting` declares are checked.

    Args:
        why: short reason for the effect; it appears in the run's report.

    Raises:
        InputError: a setting is out of range.
    """

    observable: ClassVar[Observable]

    why: str = "requested"

    def __post_init__(self) -> None:
        for f in fields(self):
            if "range" in f.metadata:
                f.metadata["range"].check(f.name, getattr(self, f.name))

    @property
    def blanks_depth(self) -> bool:
        """Return whether the effect can remove all depth of a frame."""
        return False

    def along(self, path: Trajectory) -> Self:
        """Return the effect for a camera that moves along ``path``."""
        return self

    def drops(self, index: int, generator: Callable[[int], np.random.Generator]) -> bool:
        """Return whether frame ``index`` is lost; ``generator(k)`` is the generator of frame k."""
        return False

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Simulate the sensor's frame: a pure function of ``frame`` and ``rng`` that does not write to ``frame``."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class CameraMotionEffect(SensorEffect):
    """Sensor effect of the camera's motion.

    Args:
        path: camera path; it must be known when the effect is applied.
    """

    path: Trajectory | None = None

    def along(self, path: Trajectory) -> Self:
        """Return the effect for a camera that moves along ``path``."""
        return replace(self, path=path)

    def known_path(self) -> Trajectory:
        """Return the camera path.

        Raises:
            InputError: it is not known.
        """
        if self.path is None:
            raise InputError("does not know how the camera moves.", field=self.name, hint="give it the path: along()")
        return self.path


class Effects:
    """Effects in the order in which they act on a frame; without effects, frames pass unchanged.

    Each effect draws from its own generator for each frame. The generator is seeded by ``seed``, the frame's index and
    the effect's name. A frame is therefore independent of the other frames that are read, and an additional effect does
    not change the draws of the others.
    """

    def __init__(self, effects: Sequence[SensorEffect], *, seed: int = 0) -> None:
        self.effects = tuple(effects)
        self.seed = seed
        self._frames = 0
        self._seconds = [0.0] * len(self.effects)
        self._streams = _streams([effect.name for effect in self.effects])

    def __call__(self, frame: Frame) -> Frame:
        """Apply all effects to a frame."""
        for i, effect in enumerate(self.effects):
            start = time.perf_counter()
            frame = effect.apply(frame, self._generator(i, frame.index))
            self._seconds[i] += time.perf_counter() - start
        self._frames += 1
        return frame

    def over(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames of a stream that arrive, after all effects, one at a time."""
        return (self(frame) for frame in frames if not self._drops(frame.index))

    def along(self, path: Trajectory) -> Effects:
        """Return the same effects for a camera that moves along ``path``, with a new cost count."""
        return Effects([effect.along(path) for effect in self.effects], seed=self.seed)

    def kept(self, count: int) -> list[int]:
        """Return the indices of those of ``count`` frames that arrive."""
        return [index for index in range(count) if not self._drops(index)]

    @property
    def blanks_depth(self) -> bool:
        """Return whether a frame can lose all depth."""
        return any(effect.blanks_depth for effect in self.effects)

    def report(self) -> list[dict[str, Any]]:
        """Return for each effect: name, why, settings, frames and ms_per_frame (None before the first frame)."""
        per_frame = [1e3 * s / self._frames if self._frames else None for s in self._seconds]
        return [
            {"name": e.name, "why": e.why, "settings": settings(e), "frames": self._frames, "ms_per_frame": ms}
            for e, ms in zip(self.effects, per_frame, strict=True)
        ]

    def _drops(self, index: int) -> bool:
        return any(
            effect.drops(index, lambda k, i=i: self._generator(i, k))  # type: ignore[misc]
            for i, effect in enumerate(self.effects)
        )

    def _generator(self, effect: int, index: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, index, *self._streams[effect]])


def check_span(at: int, until: int) -> None:
    """Check that frames ``at`` up to ``until`` exist, where 0 means no end.

    Raises:
        InputError: the span is empty.
    """
    if at < 0:
        raise InputError(f"is {at}.", field="at", hint="give a frame number >= 0")
    if until and until <= at:
        raise InputError(f"is {until}.", field="until", hint=f"give a frame after {at}, or 0 for never")


def settings(effect: SensorEffect | type[SensorEffect]) -> dict[str, Any]:
    """Return the settings of an effect, or the default settings of a class."""
    return {f.name: getattr(effect, f.name) for f in fields(effect) if f.name not in _NO_SETTINGS}


def _streams(names: Sequence[str]) -> list[tuple[int, int]]:
    """Return for each effect a hash of its name, and the number of earlier effects with the same name."""
    return [(zlib.crc32(name.encode()), names[:i].count(name)) for i, name in enumerate(names)]
