"""What a sensor effect is, and the account of those that are on."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.trajectory import Trajectory

Observable = Literal["colors", "depth", "stamps", "arrivals"]
"""What of a stream of frames an effect changes."""

# Fields of an effect's dataclass that no user sets: what it is called, who asked for it, how the camera moved.
_NO_SETTINGS = ("name", "why", "path")


class Effect(Protocol):
    """Something that a real sensor does to an ideal frame; a frozen dataclass whose fields are its settings.

    ``cost`` says what it computes for a frame; ``observable`` what of the frames changes with it.
    """

    cost: ClassVar[str]
    observable: ClassVar[Observable]

    @property
    def name(self) -> str:
        """Short name; what the registry knows it by."""
        ...

    @property
    def why(self) -> str:
        """Who asked for it, in a few words; appears in the run's account."""
        ...

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame as the sensor would have given it: a pure function of both, ``frame`` is not written to."""
        ...


@runtime_checkable
class FollowsPath(Protocol):
    """An effect that needs to know how the camera moves."""

    def along(self, path: Trajectory) -> Effect:
        """The effect for a camera that moves along ``path``."""
        ...


@runtime_checkable
class DropsFrames(Protocol):
    """An effect that loses whole frames."""

    def drops(self, index: int, generator: Callable[[int], np.random.Generator]) -> bool:
        """Whether frame ``index`` is lost; ``generator(k)`` gives the k-th frame's generator, the same every time."""
        ...


@runtime_checkable
class BlanksDepth(Protocol):
    """An effect that may leave a frame without any depth."""

    @property
    def blanks_depth(self) -> bool:
        """Whether this one does."""
        ...


class Effects:
    """Effects in the order in which they happen to a frame; without any, frames pass untouched.

    For each frame each effect draws from its own generator, seeded by ``seed``, the frame's index and the effect's
    name: frame 7 is the same whether or not frame 6 was asked for, and one effect more changes no other's draws.
    """

    def __init__(self, effects: Sequence[Effect], *, seed: int = 0) -> None:
        self.effects = tuple(effects)
        self.seed = seed
        self._frames = 0
        self._seconds = [0.0] * len(self.effects)
        self._streams = _streams([effect.name for effect in self.effects])

    def __call__(self, frame: Frame) -> Frame:
        """The frame after all effects."""
        for i, effect in enumerate(self.effects):
            start = time.perf_counter()
            frame = effect.apply(frame, self._generator(i, frame.index))
            self._seconds[i] += time.perf_counter() - start
        self._frames += 1
        return frame

    def over(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames of a stream that arrive, after all effects, one at a time."""
        return (self(frame) for frame in frames if not self._drops(frame.index))

    def along(self, path: Trajectory) -> Effects:
        """The same effects for a camera that moves along ``path``, with a fresh account."""
        return Effects([e.along(path) if isinstance(e, FollowsPath) else e for e in self.effects], seed=self.seed)

    def kept(self, count: int) -> list[int]:
        """Those of ``count`` frames that arrive."""
        return [index for index in range(count) if not self._drops(index)]

    @property
    def blanks_depth(self) -> bool:
        """Whether a frame may come out without any depth."""
        return any(isinstance(effect, BlanksDepth) and effect.blanks_depth for effect in self.effects)

    def report(self) -> list[dict[str, Any]]:
        """For each effect: name, why, settings, frames and ms_per_frame (None before the first frame)."""
        per_frame = [1e3 * s / self._frames if self._frames else None for s in self._seconds]
        return [
            {"name": e.name, "why": e.why, "settings": settings(e), "frames": self._frames, "ms_per_frame": ms}
            for e, ms in zip(self.effects, per_frame, strict=True)
        ]

    def _drops(self, index: int) -> bool:
        return any(
            isinstance(effect, DropsFrames) and effect.drops(index, lambda k, i=i: self._generator(i, k))  # type: ignore[misc]
            for i, effect in enumerate(self.effects)
        )

    def _generator(self, effect: int, index: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, index, *self._streams[effect]])


def check_span(at: int, until: int) -> None:
    """Frames ``at`` up to ``until``, or for ever if that is 0.

    Raises:
        InputError: there are none.
    """
    if at < 0:
        raise InputError(f"is {at}.", field="at", hint="give a frame number >= 0")
    if until and until <= at:
        raise InputError(f"is {until}.", field="until", hint=f"give a frame after {at}, or 0 for never")


def settings(effect: Effect | type) -> dict[str, Any]:
    """The settings of an effect; of a class, their defaults."""
    if not is_dataclass(effect):
        return {}
    return {f.name: getattr(effect, f.name) for f in fields(effect) if f.name not in _NO_SETTINGS}


def _streams(names: Sequence[str]) -> list[tuple[int, int]]:
    """Per effect a number of its name, and how many of that name came before it."""
    return [(zlib.crc32(name.encode()), names[:i].count(name)) for i, name in enumerate(names)]
