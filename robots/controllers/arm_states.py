"""Joint states that an arm reports, by name, with their age."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatbot.protocols import Array

_WINDOW_S = 0.3  # [s] states that decide whether the arm rests
_LEAST_S = 0.1  # [s] they must span, by their stamps and by their arrivals
_FEWEST = 3  # that decide: two may lie on both sides of a turning point
_MOST = 2000  # states that are kept, however slowly the clock of a simulated robot runs
_STILL = 1e-3  # [rad or m] largest motion of an arm at rest within them


@dataclass(frozen=True, eq=False)
class _Sample:
    arrived: float
    stamp: int
    position: Array
    velocity: Array | None


class ArmStates:
    """The latest states of an arm's joints. Messages may have any order of names, and other joints.

    A message without all joints, with values that are not finite, or with a stamp that is not after the one before has
    no effect. The age counts from the arrival of the latest message that had one.

    Args:
        names: names of the joints.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._samples: deque[_Sample] = deque(maxlen=_MOST)
        self._restarted = False
        self._lock = threading.Lock()

    def restart(self) -> None:
        """Accept any stamp next: the clock of the robot may be another one after a lost connection."""
        self._restarted = True

    def take(self, message: Mapping[str, Any]) -> None:
        """Take a ``sensor_msgs/JointState`` in the format of rosbridge.

        Raises:
            LookupError: a field is missing.
            TypeError, ValueError: a field has another type.
        """
        index = {name: at for at, name in enumerate(message["name"])}
        if not all(name in index for name in self._names):
            return
        columns = [index[name] for name in self._names]
        position = np.array([float(message["position"][at]) for at in columns])
        given = message.get("velocity") or []
        velocity = np.array([float(given[at]) for at in columns]) if len(given) == len(index) else None
        stamp = nanoseconds(message["header"]["stamp"])
        if not np.isfinite(position).all() or (velocity is not None and not np.isfinite(velocity).all()):
            return
        now = time.monotonic()
        with self._lock:
            if self._restarted:
                self._samples.clear()
            elif self._samples and stamp <= self._samples[-1].stamp:
                return
            self._restarted = False
            self._samples.append(_Sample(now, stamp, position, velocity))
            while len(self._samples) > _FEWEST and _span(self._samples[0], self._samples[-1]) > _WINDOW_S:
                self._samples.popleft()

    @property
    def age(self) -> float:
        """Age of the latest state [s]; infinity without one."""
        with self._lock:
            return time.monotonic() - self._samples[-1].arrived if self._samples else np.inf

    @property
    def rests(self) -> bool:
        """True if the arm did not move in the last states, whose time counts by stamps, too: they may arrive late."""
        return self.rests_since(-np.inf)

    def rests_since(self, arrived: float) -> bool:
        """Return whether the arm did not move in the last states that arrived after a time [s] of the monotonic clock.

        After a lost connection, earlier states do not count.
        """
        with self._lock:
            samples = [] if self._restarted else [each for each in self._samples if each.arrived > arrived]
        if len(samples) < _FEWEST or _span(samples[0], samples[-1]) < _LEAST_S:
            return False
        return bool(np.ptp([sample.position for sample in samples], axis=0).max() <= _STILL)

    def latest(self) -> tuple[Array, Array] | None:
        """Return the latest position and velocity (J,), or None; velocities that are not reported are estimated."""
        with self._lock:
            samples = list(self._samples)[-2:]
        if not samples:
            return None
        last, first = samples[-1], samples[0]
        if last.velocity is not None or last is first:
            return last.position, np.zeros_like(last.position) if last.velocity is None else last.velocity
        return last.position, (last.position - first.position) / (1e-9 * (last.stamp - first.stamp))


def _span(first: _Sample, last: _Sample) -> float:
    """Return the time [s] from one state to another, by the clock on which less has passed."""
    return min(last.arrived - first.arrived, 1e-9 * (last.stamp - first.stamp))


def nanoseconds(stamp: Mapping[str, Any]) -> int:
    """Return a stamp of ROS 2 (sec, nanosec) or ROS 1 (secs, nsecs) in nanoseconds."""
    if "sec" in stamp:
        return int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])
    return int(stamp["secs"]) * 10**9 + int(stamp["nsecs"])
