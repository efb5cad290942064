"""Account of the time that a viewer takes from the training that it shows."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

Clock = Callable[[], float]
"""Returns the time [s]."""


@dataclass(frozen=True)
class ViewerBudgetConstants:
    """Constants of the account.

    Args:
        share: of the elapsed time that the viewer may take.
        margin: credit that work needs to begin [predicted costs].
        burst: [s] most time that is saved up, beyond that which dearer work needs.
        forgetting: factor by which a measured cost falls at the next, cheaper measurement.
    """

    share: float = 0.05
    margin: float = 2.0
    burst: float = 0.5
    forgetting: float = 0.8


CONSTANTS = ViewerBudgetConstants()


class ViewerBudget:
    """A credit of time that grows by a share of the elapsed time, and that work of the viewer uses up.

    Work begins when the credit covers its predicted cost with a margin. Work that took still longer leaves a debt,
    which is repaid before the next begins.

    Args:
        clock: of the process.
    """

    def __init__(self, clock: Clock = time.perf_counter) -> None:
        self.clock = clock
        self.spent_s = 0.0
        self._began = self._then = clock()
        self._credit_s = 0.0
        self._most_s = CONSTANTS.burst

    def covers(self, cost_s: float) -> bool:
        """Return whether work of a predicted cost [s] may begin now."""
        now, needed = self.clock(), CONSTANTS.margin * cost_s
        if needed > CONSTANTS.burst:
            self._most_s = needed + CONSTANTS.burst
        self._credit_s = min(self._most_s, self._credit_s + CONSTANTS.share * (now - self._then))
        self._then = now
        return self._credit_s >= needed

    def spend(self, seconds: float) -> None:
        """Charge time that the viewer took [s]."""
        self._credit_s -= seconds
        self.spent_s += seconds

    @property
    def used(self) -> float:
        """Return the share of the elapsed time that the viewer has taken, 0 to 1."""
        elapsed = self.clock() - self._began
        return self.spent_s / elapsed if elapsed > 0 else 0.0


class ImageCosts:
    """Predicts from earlier images how long the next one takes.

    An image takes at most as long as a larger one, and at most the ratio of their pixels longer than a smaller one.
    """

    def __init__(self) -> None:
        self._known: dict[int, float] = {}

    def note(self, width: int, seconds: float) -> None:
        """Note the cost [s] of an image of a width [px]."""
        self._known[width] = max(seconds, CONSTANTS.forgetting * self._known.get(width, 0.0))

    def predict(self, width: int, unknown: float) -> float:
        """Return the least bound [s] of the cost of an image, or ``unknown`` before the first."""
        bounds = [cost * max(1.0, (width / known) ** 2) for known, cost in self._known.items()]
        return min(bounds, default=unknown)

    def largest(self, widths: Sequence[int], seconds: float, unknown: float) -> int:
        """Return the largest of ascending ``widths`` whose image takes at most ``seconds``, or else the smallest."""
        fitting = [width for width in widths if self.predict(width, unknown) <= seconds]
        return fitting[-1] if fitting else widths[0]
