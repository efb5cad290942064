"""Following a trajectory: what became of it, how far off it was, and a stop within one period when told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatbot.protocols import Array, Controller, Feedback, MotionState, TimedPath

_PATIENCE = 1.0  # [s] after the trajectory's end in which the arm may still arrive


@dataclass(frozen=True, eq=False)
class Followed:
    """What became of a trajectory.

    Args:
        state: how it ended: done, stopped or fault.
        fault: why it is at fault, if it is.
        time: (N,) [s] of each period.
        position, desired: (N, J) measured, and where the trajectory has it.
    """

    state: MotionState
    fault: str
    time: Array
    position: Array
    desired: Array

    @property
    def error(self) -> Array:
        """The largest difference between the two at each period (N,) [rad or m]."""
        return np.asarray(np.abs(self.position - self.desired).max(axis=1))

    def __bool__(self) -> bool:
        return self.state is MotionState.DONE


def follow(
    controller: Controller, trajectory: TimedPath, *, stop: Callable[[Feedback], bool] | None = None
) -> Followed:
    """Send a trajectory and step until the arm has arrived, was stopped, or is at fault.

    Args:
        controller: of the arm.
        trajectory: to follow.
        stop: asked at each period; True stops the arm within the next one.

    Raises:
        ControllerError: the controller does not take the trajectory.
    """
    controller.send(trajectory)
    seen: list[Feedback] = []
    most = int((trajectory.duration + _PATIENCE) / controller.period) + 2
    while len(seen) < most:
        seen.append(controller.step())
        if seen[-1].state is not MotionState.MOVING:
            break
        if stop is not None and stop(seen[-1]):
            controller.stop()
            stop = None
    if seen[-1].state is MotionState.MOVING:  # it never arrived
        controller.stop()
        seen.append(controller.step())
    last = seen[-1]
    return Followed(
        last.state,
        last.fault,
        np.array([f.time for f in seen]),
        np.stack([f.position for f in seen]),
        np.stack([f.desired for f in seen]),
    )
