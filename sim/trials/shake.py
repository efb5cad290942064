"""Shaking of a held object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.planning import WaypointMotion
from splatbot.protocols import Array, KinematicChain


@dataclass(frozen=True)
class ShakeConstants:
    """Constants of the shaking motion."""

    rate: float = 3.0
    """Frequency [Hz] of the motion. A higher one has smaller amplitudes at the same acceleration."""
    duration: float = 2.0
    """Length [s] of the motion. A longer one lets an object that slips fall."""
    acceleration_share: float = 0.6
    """Amplitude of the acceleration [1] as a share of the joints' limits. A larger one pulls harder on the held object
    and leaves the controller less reserve."""
    period: float = 0.005
    """Time [s] between the waypoints of the motion. A longer one flattens the peaks of the sinusoid."""


CONSTANTS = ShakeConstants()


@dataclass(frozen=True, eq=False)
class Shake:
    """Sinusoidal motion of every joint about its position, with a smooth start and end.

    Accelerations stay within the constant share of the joints' limits in the middle, and joints within their ranges.

    Args:
        chain: of the arm.
        q: (J,) centre of the motion.
        duration: [s].
    """

    chain: KinematicChain
    q: Array
    duration: float = CONSTANTS.duration

    @property
    def amplitude(self) -> Array:
        """Amplitude of each joint (J,) [rad]; signs alternate."""
        most = CONSTANTS.acceleration_share * self.chain.acceleration / (2 * np.pi * CONSTANTS.rate) ** 2
        inside = np.minimum(self.q - self.chain.lower, self.chain.upper - self.q)
        return np.asarray(np.minimum(most, np.maximum(inside, 0.0)) * (-1.0) ** np.arange(len(self.q)))

    def reference(self, t: float) -> tuple[Array, Array]:
        """Implement :meth:`splatbot.protocols.TimedPath.reference`."""
        x = float(np.clip(t, 0.0, self.duration))
        w, grow = 2 * np.pi * CONSTANTS.rate, np.pi / self.duration
        swell, turn = np.sin(grow * x) ** 2, np.sin(w * x)
        rate = grow * np.sin(2 * grow * x) * turn + w * swell * np.cos(w * x)
        return self.q + self.amplitude * (swell * turn), self.amplitude * (rate if x == t else 0.0)

    def motion(self) -> WaypointMotion:
        """Return the spline through the positions at every period of ``CONSTANTS.period``."""
        count = round(self.duration / CONSTANTS.period)
        times = np.linspace(0.0, self.duration, count + 1)
        return WaypointMotion(times, np.array([self.reference(float(t))[0] for t in times]))


def strength(shake: Shake, tool: Array) -> float:
    """Compute the largest acceleration of a tool [m/s²] from its positions (N, 3) [m] at N equally spaced times."""
    step = shake.duration / (len(tool) - 1)
    return float(np.linalg.norm(np.diff(tool, n=2, axis=0), axis=1).max() / step**2)
