"""Shaking what is held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.protocols import Array, KinematicChain

RATE = 3.0  # [Hz]
SECONDS = 2.0
SHARE = 0.6  # of the joints' limits of acceleration


@dataclass(frozen=True, eq=False)
class Shake:
    """Every joint to and fro about where it is, growing at the start and fading at the end.

    Accelerations stay within ``SHARE`` of the joints' limits in the middle, and joints within their ranges.

    Args:
        chain: of the arm.
        q: (J,) about which.
        duration: [s].
    """

    chain: KinematicChain
    q: Array
    duration: float = SECONDS

    @property
    def amplitude(self) -> Array:
        """Of each joint (J,) [rad]; every other one moves the other way."""
        most = SHARE * self.chain.acceleration / (2 * np.pi * RATE) ** 2
        inside = np.minimum(self.q - self.chain.lower, self.chain.upper - self.q)
        return np.asarray(np.minimum(most, np.maximum(inside, 0.0)) * (-1.0) ** np.arange(len(self.q)))

    def reference(self, t: float) -> tuple[Array, Array]:
        """See :class:`splatbot.protocols.TimedPath`."""
        x = float(np.clip(t, 0.0, self.duration))
        w, grow = 2 * np.pi * RATE, np.pi / self.duration
        swell, turn = np.sin(grow * x) ** 2, np.sin(w * x)
        rate = grow * np.sin(2 * grow * x) * turn + w * swell * np.cos(w * x)
        return self.q + self.amplitude * (swell * turn), self.amplitude * (rate if x == t else 0.0)


def strength(shake: Shake, tool: Array) -> float:
    """The largest acceleration of a tool's place [m/s²]; ``tool`` are its places (N, 3) [m] at N even times."""
    step = shake.duration / (len(tool) - 1)
    return float(np.linalg.norm(np.diff(tool, n=2, axis=0), axis=1).max() / step**2)
