"""Errors of an estimated trajectory against a reference: ATE and RPE (Sturm et al. 2012), as `evo` computes them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import inverse, so3_log, transform_points
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MAX_DIFFERENCE = 0.01  # [s] between associated stamps; evo's default


@dataclass(frozen=True)
class AbsoluteError:
    """Absolute trajectory error after SE(3) alignment, translation part.

    Args:
        rmse, mean, median, max: [m], over all associated frames.
        stamps: (M,) of the estimate [s].
        errors: (M,) [m], one for each associated frame.
        T_reference_estimate: (4, 4) alignment that was applied to the estimate.
    """

    rmse: float
    mean: float
    median: float
    max: float
    stamps: Array
    errors: Array
    T_reference_estimate: Array


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error between consecutive associated frames.

    Args:
        trans_rmse, rot_rmse: [m], [rad].
        stamps: (M-1,) [s] of the later frame of each pair.
        trans, rot: (M-1,) [m], [rad].
    """

    trans_rmse: float
    rot_rmse: float
    stamps: Array
    trans: Array
    rot: Array


def associate(
    reference: Trajectory, estimate: Trajectory, max_difference: float = MAX_DIFFERENCE
) -> tuple[Index, Index]:
    """Associate the poses of two trajectories by their stamps: for each of the shorter, the nearest of the longer.

    Returns:
        Indices (M,) into the reference and (M,) into the estimate.

    Raises:
        InputError: no stamps are within ``max_difference`` [s].
    """
    swap = len(estimate) > len(reference)
    short, long = (reference, estimate) if swap else (estimate, reference)
    if len(short) == 0:
        raise InputError("has no poses.", field="trajectory", hint="nothing can be compared")
    nearest = _nearest(short.stamps, long.stamps)
    close = np.abs(long.stamps[nearest] - short.stamps) <= max_difference
    if not close.any():
        raise InputError(
            f"no stamps within {max_difference} s of each other (reference {_span(reference)}, estimate "
            f"{_span(estimate)}).",
            field="stamps",
            hint="give both trajectories in seconds of the same clock",
        )
    of_short, of_long = np.flatnonzero(close), nearest[close]
    return (of_short, of_long) if swap else (of_long, of_short)


def align(reference: Array, estimate: Array) -> Array:
    """Compute the rigid transform (4, 4) that aligns points (N, 3) [m] to a reference (N, 3) [m] by least squares.

    Umeyama (1991), without scale.
    """
    mean_r, mean_e = reference.mean(axis=0), estimate.mean(axis=0)
    U, _, Vt = np.linalg.svd((reference - mean_r).T @ (estimate - mean_e))
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    T = np.eye(4)
    T[:3, :3] = U @ S @ Vt
    T[:3, 3] = mean_r - T[:3, :3] @ mean_e
    return T


def absolute_error(
    reference: Trajectory, estimate: Trajectory, max_difference: float = MAX_DIFFERENCE
) -> AbsoluteError:
    """Compute the ATE; equal to `evo_ape tum reference estimate -a`.

    Raises:
        InputError: no stamps are within ``max_difference`` [s].
    """
    of_reference, of_estimate = associate(reference, estimate, max_difference)
    ref, est = reference.positions[of_reference], estimate.positions[of_estimate]
    T = align(ref, est)
    errors = np.linalg.norm(transform_points(T, est) - ref, axis=1)
    return AbsoluteError(
        rmse=_rms(errors),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        max=float(errors.max()),
        stamps=estimate.stamps[of_estimate],
        errors=errors,
        T_reference_estimate=T,
    )


def relative_error(
    reference: Trajectory, estimate: Trajectory, max_difference: float = MAX_DIFFERENCE
) -> RelativeError:
    """Compute the RPE per frame; equal to `evo_rpe tum reference estimate --delta 1 --delta_unit f`.

    Raises:
        InputError: fewer than two frames can be associated.
    """
    of_reference, of_estimate = associate(reference, estimate, max_difference)
    if len(of_reference) < 2:
        raise InputError("only one frame can be associated.", field="stamps", hint="a relative error needs two")
    steps = _steps(reference.T_world_camera[of_reference]), _steps(estimate.T_world_camera[of_estimate])
    differences = [inverse(r) @ e for r, e in zip(*steps, strict=True)]
    trans = np.array([np.linalg.norm(E[:3, 3]) for E in differences])
    rot = np.array([np.linalg.norm(so3_log(E[:3, :3])) for E in differences])
    return RelativeError(_rms(trans), _rms(rot), estimate.stamps[of_estimate[1:]], trans, rot)


def _steps(poses: Array) -> list[Array]:
    """Return the motion (4, 4) from each pose (N, 4, 4) to the next, in the frame of the earlier one."""
    return [inverse(a) @ b for a, b in pairwise(poses)]


def _nearest(stamps: Array, among: Array) -> Index:
    """Return for each stamp the index of the nearest of ``among`` (increasing); ties go to the earlier one."""
    right = np.clip(np.searchsorted(among, stamps), 1, max(len(among) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(among) - 1)
    return np.where(np.abs(among[right] - stamps) < np.abs(stamps - among[left]), right, left)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _span(trajectory: Trajectory) -> str:
    return f"{trajectory.stamps[0]:.3f}..{trajectory.stamps[-1]:.3f} s"
