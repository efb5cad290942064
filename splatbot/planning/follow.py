"""Following a trajectory with a controller: final state, tracking error, and a stop within one period on request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatbot.planning.certify import CertifiedMotion
from splatbot.protocols import Array, Controller, Feedback, MotionState

_SETTLING_TIME = 1.0  # [s] after the end of the trajectory in which the arm may still arrive


@dataclass(frozen=True, eq=False)
class Followed:
    """Record of a followed trajectory. True if the arm arrived.

    Args:
        state: final state: done, stopped or fault.
        fault: cause of the fault; empty without a fault.
        time: (N,) time of each period since the start [s].
        position, desired: (N, J) measured positions and positions of the trajectory [rad or m].
    """

    state: MotionState
    fault: str
    time: Array
    position: Array
    desired: Array

    @property
    def error(self) -> Array:
        """Largest absolute tracking error of any joint at each period (N,) [rad or m]."""
        return np.asarray(np.abs(self.position - self.desired).max(axis=1))

    def __bool__(self) -> bool:
        return self.state is MotionState.DONE


def follow(
    controller: Controller, motion: CertifiedMotion, *, stop: Callable[[Feedback], bool] | None = None
) -> Followed:
    """Send a certified motion and step until the arm arrives, is stopped or reports a fault.

    Args:
        controller: controller of the arm.
        motion: motion that begins at the arm's position, see :func:`splatbot.planning.certify_motion`.
        stop: predicate that is evaluated at each period; True stops the arm within the next period.

    Raises:
        ControllerError: the controller does not take the motion.
    """
    controller.send(motion)
    feedback: list[Feedback] = []
    max_periods = int((motion.duration + _SETTLING_TIME) / controller.period) + 2
    try:
        while len(feedback) < max_periods:
            feedback.append(controller.step())
            if feedback[-1].state is not MotionState.MOVING:
                break
            if stop is not None and stop(feedback[-1]):
                controller.stop()
                stop = None
        if feedback[-1].state is MotionState.MOVING:  # the arm does not arrive in time
            controller.stop()
            feedback.append(controller.step())
    except BaseException:  # as Ctrl-C: an arm goes on by itself otherwise
        controller.stop()
        raise
    last = feedback[-1]
    return Followed(
        last.state,
        last.fault,
        np.array([f.time for f in feedback]),
        np.stack([f.position for f in feedback]),
        np.stack([f.desired for f in feedback]),
    )
