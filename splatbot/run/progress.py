"""Where a run stands, for displays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from splatbot.slam import FrameResult

Phase = Literal["calibrating", "mapping", "refining", "saving", "scoring", "reporting"]


@dataclass(frozen=True)
class Progress:
    """Progress of a run.

    Args:
        phase: current phase.
        done: frames read so far, of ``total``.
        total: frames to read; 0 if it is unknown.
        elapsed_s: time since the first frame [s].
        result: result of the latest frame; None if it could not be read, and after the last.
        skipped: reason why the latest frame could not be read, "" otherwise.
        warning: a problem that did not end the run, "" without one.
        keyframes: frames that entered the map so far.
        lost: frames lost so far.
        gaussians: size of the map.
        step, steps: progress in a phase other than mapping: iterations of the refinement, keyframes to save, views to
            score. ``steps`` is 0 if it is unknown.
        late, dropped: frames of a paced run that were unfinished, or not started, when the next one arrived.
    """

    phase: Phase
    done: int
    total: int
    elapsed_s: float
    result: FrameResult | None = None
    skipped: str = ""
    warning: str = ""
    keyframes: int = 0
    lost: int = 0
    gaussians: int = 0
    step: int = 0
    steps: int = 0
    late: int = 0
    dropped: int = 0
