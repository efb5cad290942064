"""A controller that follows its trajectory with a lag and noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from splatbot.errors import InputError
from splatbot.protocols import Array
from splatbot.robots.controllers.base import CONSTANTS as CONTROLLER
from splatbot.robots.controllers.base import SteppedController


class FakeController(SteppedController):
    """A first-order lag behind the trajectory, with noise in the measured positions.

    Args:
        position: (J,) position of the arm [rad or m].
        period: control period [s].
        lag: time constant [s]; 0 follows the trajectory exactly.
        noise: standard deviation of a measured position [rad or m].
        following: see :class:`SteppedController`.
        seed: seed of the noise.

    Raises:
        InputError: a value is out of range.
    """

    def __init__(
        self,
        position: ArrayLike,
        *,
        period: float = 1e-3,
        lag: float = 0.0,
        noise: float = 0.0,
        following: float = CONTROLLER.max_tracking_error,
        seed: int = 0,
    ) -> None:
        super().__init__(np.asarray(position, dtype=np.float64), period=period, following=following)
        if not (0.0 <= lag < np.inf and 0.0 <= noise < np.inf):
            raise InputError(f"is {lag}, {noise}.", field="lag, noise", hint="give 0 or more")
        self._lag, self._noise = lag, noise
        self._rng = np.random.default_rng(seed)
        self._true = self._position.copy()

    def _moved(self, t: float, desired: Array, velocity: Array) -> Array:
        share = 1.0 - np.exp(-self._period / self._lag) if self._lag > 0.0 else 1.0
        self._true = self._true + share * (desired - self._true)
        return self._true + self._rng.normal(0.0, self._noise, desired.shape) if self._noise else self._true.copy()
