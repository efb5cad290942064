"""Two recordings of one motion: the arm's joints or poses over time, and tracked poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.link_motion import JointLinkMotion, LinkMotion, PoseLinkMotion, link_poses
from splatbot.calibration.measurements import PoseMeasurement
from splatbot.calibration.time_offset import cross_correlate
from splatbot.errors import InputError
from splatbot.formats.trajectory import load_trajectory
from splatbot.logs.joints import MAX_GAP
from splatbot.protocols import KinematicChain
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_POSES = 600
"""Largest number of tracked poses of a problem [1]; more change the result less than its standard deviation."""
_SAME_INSTANT = 1e-6  # [s] between stamps of views that were recorded together
_AROUND = 2.0  # [s] of the arm's record before and after the tracked poses that are kept
_MAX_PERIOD = 0.2  # [s] of recordings whose time offset can be estimated


def load_stream(path: Path) -> Trajectory:
    """Read a pose file in any order; of equal stamps, the first pose is kept.

    Raises:
        FormatError: the file is missing or damaged.
    """
    return load_trajectory(path, unordered=True)


def align_streams(
    tracked: Trajectory,
    stamps: Array,
    *,
    T_base_link: Array | None = None,
    joints: Array | None = None,
    chain: KinematicChain | None = None,
    link: int = 0,
    same_clock: bool = False,
) -> tuple[LinkMotion, PoseMeasurement, float | None]:
    """Return motion and measurement at the tracked poses for which the arm is known.

    The time offset of two recordings at 5 Hz or more starts with :func:`cross_correlate`. Slower ones must have the
    same clock. An arm that is recorded at less than 5 Hz is known only at the stamps of its record.

    Args:
        tracked: tracked poses over time.
        stamps: (N,) times of the arm [s].
        T_base_link: (N, 4, 4) poses of the link, or None with ``joints`` (N, J), ``chain`` and ``link``.
        joints, chain, link: see ``T_base_link``.
        same_clock: the stamps of both agree.

    Returns:
        Motion, measurement, and the time offset [s] that the stamps of the motion lack, None if both have one clock.

    Raises:
        InputError: the recordings do not overlap, or their motions do not agree.
    """
    arm = T_base_link if joints is None or chain is None else link_poses(chain, joints, link)
    if arm is None:
        raise InputError("needs joints or poses.", field="motion")
    periods = [float(np.median(np.diff(s))) if len(s) > 1 else np.inf for s in (tracked.stamps, stamps)]
    delay = (
        None
        if same_clock or max(periods) > _MAX_PERIOD
        else cross_correlate(stamps, arm, tracked.stamps, tracked.T_world_camera)
    )
    origin = float(tracked.stamps[0])
    at, times = tracked.stamps - origin, stamps - (origin + (delay or 0.0))
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
    near = (times > at[rows[0]] - _AROUND) & (times < at[rows[-1]] + _AROUND)
    if joints is None or chain is None:
        return PoseLinkMotion(arm[near], times[near], at[rows]), measured, delay
    return JointLinkMotion(chain, joints[near], link, times[near], at[rows]), measured, delay
