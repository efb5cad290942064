"""RGB-D Gaussian SLAM, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.frame import Frame
from splatbot.gaussians import Snapshot

Verdict = Literal["ok", "degraded", "lost"]


@dataclass(frozen=True)
class FrameResult:
    """What became of one frame.

    Args:
        T_world_camera: (4, 4), world = first camera; None when lost.
        verdict: "ok", "degraded" (tracked, with ``reasons`` to doubt it) or "lost" (map frozen).
        stage: the stage whose pose was taken.
        stage_ms: milliseconds by stage.
        keyframe: whether the frame entered the map.
        gaussians: size of the map afterwards.
    """

    index: int
    stamp: float
    T_world_camera: NDArray[np.float64] | None
    verdict: Verdict
    reasons: tuple[str, ...] = ()
    stage: str = ""
    stage_ms: dict[str, float] = field(default_factory=dict)
    keyframe: bool = False
    gaussians: int = 0


class Slam:
    """Tracks and maps a stream; ``results`` holds one entry per processed frame."""

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self.results: list[FrameResult] = []

    def process(self, frame: Frame, *, hold_out: bool = False) -> FrameResult:
        """Track ``frame`` and, unless ``hold_out``, fuse it. Never raises for a frame that cannot be tracked."""
        raise NotImplementedError

    def finish(self) -> None:
        """Spend the last refinement on the map once the stream has ended."""
        raise NotImplementedError

    def snapshot(self) -> Snapshot:
        """The map as it is now, immutable."""
        raise NotImplementedError
