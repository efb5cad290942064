"""Time budget of a frame, and the model of the durations of work that it is based on."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class CostModelConstants:
    """Empirical constants of the cost model."""

    history: int = 40
    """Number of recent runs [1] per kind of work. More runs make the quantile smoother and slower to adapt."""
    max_age: int = 60
    """Age [frames] at which a run is forgotten. Work that was too slow once is tried again after it."""
    unknown_factor: float = 1.5
    """Factor [1] on the table for work with fewer than two runs. A larger factor starts new stages later."""
    deadline_quantile: float = 0.95
    """Quantile [1] of recent durations that a stage is expected to take. A larger one keeps the deadline more often."""
    lost_quantile: float = 0.5
    """The quantile [1] for a lost camera. Being late costs it little, and two slow runs would keep it lost."""


CONSTANTS = CostModelConstants()

# Milliseconds of each kind of work on one idle Zen 4 core: fixed, and per unit. Deterministic mode uses this table
# alone. With the clock, the table only relates runs of different sizes.
_TABLE: dict[str, tuple[float, float]] = {
    "prepare": (0.2, 5.0e-6),  # pixels of the frame
    "geometric": (0.1, 1.0e-5),  # points, times references, levels and steps
    "direct": (0.1, 1.5e-5),  # points, times references, levels and steps
    "direct steps": (0.1, 1.5e-5),  # the same with fewer steps, which cost more than their share
    "matches": (0.0, 2.5e-5),  # matched features, times levels and steps
    "health": (0.1, 6.0e-5),  # points, times references
    "detect": (4.1, 3.6e-3),  # keypoints
    "match near": (1.2, 1.3e-6),  # keypoints, times keypoints of a keyframe
    "match all": (0.8, 2.3e-6),  # keypoints, times keypoints of a keyframe
    "vote": (0.0, 0.5),  # keyframes
    "gicp": (3.0, 6.0e-3),  # points
    "overhead": (1.0, 0.0),  # work outside the stages: covariance, transfer to mapping, the code between stages
}
_DEFAULT_WORK = (0.0, 1.0)  # work without a row: its units are milliseconds


def table_ms(kind: str, units: float) -> float:
    """Return the expected duration [ms] of some units of work by the fixed table."""
    fixed, per_unit = _TABLE.get(kind, _DEFAULT_WORK)
    return fixed + per_unit * units


class CostModel:
    """Durations of recent runs, relative to the table; it persists from frame to frame.

    A single slow run has no effect, because the machine may have paused. A kind of work is slow after two slow runs,
    and until both are forgotten.
    """

    def __init__(self) -> None:
        self._frame = 0
        self._runs: dict[str, list[tuple[int, float]]] = {}

    def begin_frame(self) -> None:
        """Count the next frame."""
        self._frame += 1

    def record(self, kind: str, units: float, ms: float) -> None:
        """Record the duration [ms] of a run."""
        recent = self._runs.setdefault(kind, [])
        recent.append((self._frame, ms / table_ms(kind, units)))
        del recent[: -CONSTANTS.history]

    def expected_ms(self, kind: str, units: float, quantile: float = CONSTANTS.deadline_quantile) -> float:
        """Return the quantile of the durations [ms] that recent runs would have with this number of units."""
        oldest = self._frame - CONSTANTS.max_age
        ratios = sorted(ratio for frame, ratio in self._runs.get(kind, ()) if frame > oldest)
        n = len(ratios)
        if n < 2:
            return table_ms(kind, units) * min([CONSTANTS.unknown_factor, *ratios])
        return table_ms(kind, units) * ratios[min(math.ceil(quantile * n), n - 1) - 1]


class Budget:
    """Time of one frame; the overhead of most frames outside their stages is reserved.

    Args:
        limit_ms: time for the frame [ms].
        costs: durations of earlier frames. If None, the table replaces the clock, so that the same frames get the same
            stages on any machine.
        started: :func:`time.perf_counter` when work on the frame began.
        quantile: quantile of recent durations that must fit the remaining time.

    Attributes:
        ms: wall-clock milliseconds by stage, in both modes.
        skipped: names of the stages that did not fit the remaining time.
    """

    def __init__(
        self, limit_ms: float, costs: CostModel | None, started: float, quantile: float = CONSTANTS.deadline_quantile
    ) -> None:
        self.limit_ms = limit_ms
        self.ms: dict[str, float] = {}
        self.skipped: list[str] = []
        self._costs = costs
        self._quantile = quantile
        self._started = started
        self._counted_ms = 0.0
        if costs is not None:
            costs.begin_frame()
        self._rest_ms = (
            table_ms("overhead", 1) if costs is None else costs.expected_ms("overhead", 1, CONSTANTS.lost_quantile)
        )

    @property
    def left_ms(self) -> float:
        """Time [ms] for stages until the deadline."""
        spent = self._counted_ms if self._costs is None else 1e3 * (time.perf_counter() - self._started)
        return self.limit_ms - self._rest_ms - spent

    def cost_ms(self, kind: str, units: float) -> float:
        """Return the expected duration [ms] of work: the quantile of recent runs, or the figure of the table."""
        return table_ms(kind, units) if self._costs is None else self._costs.expected_ms(kind, units, self._quantile)

    def fits(self, *work: tuple[str, float]) -> bool:
        """Return True if all work, each a kind with its units, fits the remaining time."""
        return sum(self.cost_ms(kind, units) for kind, units in work) <= self.left_ms

    def skip(self, stage: str) -> None:
        """Record a stage that did not fit the remaining time."""
        if stage not in self.skipped:
            self.skipped.append(stage)

    def count(self, kind: str, units: float) -> None:
        """Charge work by the table that is not measured by itself."""
        self._counted_ms += table_ms(kind, units)

    @contextmanager
    def run(self, kind: str, units: float, under: str | None = None) -> Iterator[None]:
        """Measure and charge the work inside the block; ``ms`` lists it ``under`` that name."""
        start = time.perf_counter()
        yield
        ms = 1e3 * (time.perf_counter() - start)
        name = under or kind
        self.ms[name] = self.ms.get(name, 0.0) + ms
        self._counted_ms += table_ms(kind, units)
        if self._costs is not None:
            self._costs.record(kind, units, ms)
