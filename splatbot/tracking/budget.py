"""The anytime contract: a stage that does not fit the time left is not started."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

_RECENT = 40  # runs of a stage that its cost is judged by
_FORGOTTEN = 60  # frames after which a run says nothing any more: what was too slow once is tried again
CAREFUL, BOLD = 0.95, 0.5  # shares of them that must have cost no more: to keep a deadline, or to be found again
_UNKNOWN = 1.5  # times the table's cost is expected of a stage that has not run yet

# Milliseconds of each stage on one idle Zen 4 core: fixed, and per unit of work. Deterministic mode counts by this
# table alone; otherwise it only relates runs of different sizes, and the clock has the say.
_TABLE: dict[str, tuple[float, float]] = {
    "prepare": (0.2, 5.0e-6),  # pixels of the frame
    "geometric": (0.1, 1.0e-5),  # points, times references, levels and steps
    "direct": (0.1, 1.5e-5),  # points, times references, levels and steps
    "direct steps": (0.1, 1.5e-5),  # the same in fewer steps, which costs more than their share
    "matches": (0.0, 2.5e-5),  # matched features, times levels and steps
    "health": (0.1, 6.0e-5),  # points, times references
    "detect": (4.1, 3.6e-3),  # keypoints
    "match near": (1.2, 1.3e-6),  # keypoints, times keypoints of a keyframe
    "match all": (0.8, 2.3e-6),  # keypoints, times keypoints of a keyframe
    "vote": (0.0, 0.5),  # keyframes
    "wide": (3.0, 6.0e-3),  # points
    "rest": (1.0, 0.0),  # what is no stage: the covariance, the hand-over to mapping, the steps in between
}


def table_ms(stage: str, units: float) -> float:
    """What a stage is expected to cost for so many units of its work, by the fixed table [ms]."""
    fixed, per_unit = _TABLE[stage]
    return fixed + per_unit * units


class Costs:
    """What stages have cost lately, against the table; kept from frame to frame.

    The slowest run is not believed by itself, for a machine hiccups, and what is not run cannot get better: a stage
    is slow when two runs say so, and for as long as they are remembered.
    """

    def __init__(self) -> None:
        self._frame = 0
        self._runs: dict[str, list[tuple[int, float]]] = {}

    def begin_frame(self) -> None:
        """That the next frame has begun."""
        self._frame += 1

    def record(self, stage: str, units: float, ms: float) -> None:
        """That a stage took so long."""
        recent = self._runs.setdefault(stage, [])
        recent.append((self._frame, ms / table_ms(stage, units)))
        del recent[:-_RECENT]

    def expected_ms(self, stage: str, units: float, share: float = CAREFUL) -> float:
        """What that share of recent runs would have cost at most for this work [ms]."""
        ratios = sorted(ratio for frame, ratio in self._runs.get(stage, ()) if frame > self._frame - _FORGOTTEN)
        n = len(ratios)
        if n < 2:
            return table_ms(stage, units) * min([_UNKNOWN, *ratios])
        return table_ms(stage, units) * ratios[min(math.ceil(share * n), n - 1) - 1]


class Budget:
    """The time of one frame.

    Args:
        limit_ms: how much there is.
        costs: of earlier frames; None counts by the table instead of the clock, so that the same frames get the same
            stages on any machine.
        started: :func:`time.perf_counter` when work on the frame began.
        share: of a stage's recent runs that must have cost no more than the time left. A camera that is lost has little
            to lose by being late: without the stages that two slow runs speak against it would stay so.

    ``ms`` are wall-clock milliseconds by stage, in either mode; ``skipped`` names what there was no time for. What most
    frames cost beside their stages is kept free.
    """

    def __init__(self, limit_ms: float, costs: Costs | None, started: float, share: float = CAREFUL) -> None:
        self.limit_ms = limit_ms
        self.ms: dict[str, float] = {}
        self.skipped: list[str] = []
        self._costs = costs
        self._share = share
        self._started = started
        self._counted = 0.0
        if costs is not None:
            costs.begin_frame()
        self._rest_ms = table_ms("rest", 1) if costs is None else costs.expected_ms("rest", 1, BOLD)

    @property
    def left_ms(self) -> float:
        """Milliseconds for stages until the deadline."""
        spent = self._counted if self._costs is None else 1e3 * (time.perf_counter() - self._started)
        return self.limit_ms - self._rest_ms - spent

    def cost_ms(self, stage: str, units: float) -> float:
        """What to expect of a stage: a percentile, the 95th unless ``share`` says otherwise, or the table's figure."""
        return table_ms(stage, units) if self._costs is None else self._costs.expected_ms(stage, units, self._share)

    def fits(self, *work: tuple[str, float]) -> bool:
        """Whether stages, each with its units of work, can be done one after the other in the time left."""
        return sum(self.cost_ms(stage, units) for stage, units in work) <= self.left_ms

    def skip(self, what: str) -> None:
        """Note that there is no time for something."""
        if what not in self.skipped:
            self.skipped.append(what)

    def count(self, stage: str, units: float) -> None:
        """Charge work that was done before, or within another stage."""
        self._counted += table_ms(stage, units)

    @contextmanager
    def run(self, stage: str, units: float, under: str | None = None) -> Iterator[None]:
        """Do a stage: its cost is charged and remembered, and shown ``under`` that name."""
        start = time.perf_counter()
        yield
        ms = 1e3 * (time.perf_counter() - start)
        name = under or stage
        self.ms[name] = self.ms.get(name, 0.0) + ms
        self._counted += table_ms(stage, units)
        if self._costs is not None:
            self._costs.record(stage, units, ms)
