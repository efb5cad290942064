"""What a sensor effect is, and the account of those that are on."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np

from splatbot.frame import Frame


class Effect(Protocol):
    """Something that a real sensor does to an ideal frame."""

    @property
    def name(self) -> str:
        """Short name, unique among the effects."""
        ...

    @property
    def why(self) -> str:
        """Who asked for it, in a few words; appears in the run's account."""
        ...

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame as the sensor would have given it: a pure function of both, ``frame`` is not written to."""
        ...


class Effects:
    """Effects in the order in which they happen to a frame; without any, frames pass untouched.

    Each frame draws from its own generator, seeded by ``seed`` and the frame's index: frame 7 is the same whether or
    not frame 6 was asked for.
    """

    def __init__(self, effects: Sequence[Effect], *, seed: int = 0) -> None:
        self.effects = tuple(effects)
        self.seed = seed
        self._frames = 0
        self._seconds = [0.0] * len(self.effects)

    def __call__(self, frame: Frame) -> Frame:
        """The frame after all effects."""
        rng = np.random.default_rng([self.seed, frame.index])
        for i, effect in enumerate(self.effects):
            start = time.perf_counter()
            frame = effect.apply(frame, rng)
            self._seconds[i] += time.perf_counter() - start
        self._frames += 1
        return frame

    def over(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames of a stream after all effects, one at a time."""
        return (self(frame) for frame in frames)

    def report(self) -> list[dict[str, Any]]:
        """For each effect: name, why, frames and ms_per_frame (None before the first frame)."""
        per_frame = [1e3 * s / self._frames if self._frames else None for s in self._seconds]
        return [
            {"name": effect.name, "why": effect.why, "frames": self._frames, "ms_per_frame": ms}
            for effect, ms in zip(self.effects, per_frame, strict=True)
        ]
