"""Two recordings of one motion: the arm's joints or poses over time, and tracked poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.link_motion import LinkMotion
from splatbot.calibration.measurements import PoseMeasurement
from splatbot.calibration.time_offset import cross_correlate
from splatbot.errors import InputError
from splatbot.logs.joints import MAX_GAP
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_POSES = 600
"""Largest number of tracked poses of a problem [1]; more change the result less than its standard deviation."""
_SAME_INSTANT = 1e-6  # [s] between stamps of views that were recorded together
_MAX_PERIOD = 0.2  # [s] of recordings whose time offset can be estimated


def align_streams(
    tracked: Trajectory, arm: LinkMotion, *, same_clock: bool = False
) -> tuple[LinkMotion, PoseMeasurement, float | None]:
    """Return motion and measurement at the tracked poses for which the arm is known.

    The time offset of two recordings at 5 Hz or more starts with :func:`cross_correlate`. Slower ones must have the
    same clock. An arm that is recorded at less than 5 Hz is known only at the stamps of its record.

    Args:
        tracked: tracked poses over time.
        arm: motion of the link over time.
        same_clock: the stamps of both agree.

    Returns:
        Motion, measurement, and the time offset [s] that the stamps of the motion lack, None if both have one clock.

    Raises:
        InputError: the arm has no stamps, the recordings do not overlap, or their motions do not agree.
    """
    if arm.stamps is None:
        raise InputError("has no stamps.", field="motion", hint="give the times of the record")
    periods = [float(np.median(np.diff(s))) if len(s) > 1 else np.inf for s in (tracked.stamps, arm.stamps)]
    delay = None
    if not same_clock and max(periods) <= _MAX_PERIOD:
        T_base_link = arm.poses(np.zeros(len(arm.offsets)), 0.0)
        delay = cross_correlate(arm.stamps, T_base_link, tracked.stamps, tracked.T_world_camera)
    origin = float(tracked.stamps[0])
    at, times = tracked.stamps - origin, arm.stamps - (origin + (delay or 0.0))
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 1)
    after = np.clip(np.searchsorted(times, at), 0, len(times) - 1)
    gap = np.maximum(np.abs(at - times[before]), np.abs(times[after] - at))
    rows = np.flatnonzero(gap <= (_SAME_INSTANT if periods[1] > _MAX_PERIOD else MAX_GAP))
    if not len(rows):
        raise InputError(
            "do not overlap in time.",
            field="recordings",
            hint="give the arm's record of this log, with its clock, in seconds",
        )
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_POSES)).round().astype(int))]
    measured = PoseMeasurement(tracked.T_world_camera[rows])
    return arm.seen_at(tracked.stamps[rows], delay or 0.0), measured, delay
