"""The course of a training as curves of bounded length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from splatbot.training.folder import ProgressRow

MOST_POINTS = 240  # an even number
_FIRST_INTERVAL_S = 1.0  # of the time of training


@dataclass(frozen=True)
class CoursePoint:
    """Values of a training over an interval.

    Args:
        seconds: time of training at its end [s].
        loss: mean over its steps.
        gaussians: their number at its end.
        steps_per_s: its steps over its time of training [1/s].
    """

    seconds: float
    loss: float
    gaussians: int
    steps_per_s: float


class TrainingCourse:
    """Points of equal intervals; when there are too many, each two become one, and intervals are twice as long.

    Args:
        rows: of the run so far, which a resumed run has.
    """

    def __init__(self, rows: Sequence[ProgressRow]) -> None:
        start = ProgressRow(0, 0.0, 0.0, None, 0)
        self.points = [_between(a, b) for a, b in pairwise([start, *rows]) if b.seconds > a.seconds]
        self._interval = _FIRST_INTERVAL_S
        self._began = self.points[-1].seconds if self.points else 0.0
        self._losses: list[float] = []

    def note(self, loss: float, seconds: float, gaussians: int) -> None:
        """Note a step: its loss, and the time of training [s] and the number of Gaussians after it."""
        self._losses.append(loss)
        took = seconds - self._began
        if took < self._interval:
            return
        steps = len(self._losses)
        self.points.append(CoursePoint(seconds, sum(self._losses) / steps, gaussians, steps / took))
        self._began, self._losses = seconds, []
        if len(self.points) == MOST_POINTS:
            self.points = [_joined(*pair) for pair in zip(self.points[::2], self.points[1::2], strict=True)]
            self._interval *= 2


def _between(a: ProgressRow, b: ProgressRow) -> CoursePoint:
    return CoursePoint(b.seconds, b.loss, b.gaussians, (b.iteration - a.iteration) / (b.seconds - a.seconds))


def _joined(a: CoursePoint, b: CoursePoint) -> CoursePoint:
    return CoursePoint(b.seconds, (a.loss + b.loss) / 2, b.gaussians, (a.steps_per_s + b.steps_per_s) / 2)
