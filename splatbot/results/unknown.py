"""Unknown space of a run within the reach of an arm, as solids for a collision field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from splatbot.collision import RobotSpheres, UnknownSpace, find_unknown
from splatbot.collision.unknown import UnknownPolicy
from splatbot.gaussians import GaussianModel
from splatbot.logs import Log
from splatbot.results.folder import RunFolder
from splatbot.results.views import raw_views


@dataclass(frozen=True)
class RunUnknownConstants:
    """Constants of unknown space within the reach of an arm.

    Args:
        voxel: [m] smallest edge length of a voxel.
        max_voxels: largest number of voxels; a larger box has larger voxels.
        samples: number of random configurations that determine the reach.
        slack: [m] additional room around the arm at the start, because a certificate needs a clearance above 0.
    """

    voxel: float = 0.01
    max_voxels: int = 10_000_000
    samples: int = 500
    slack: float = 0.001


CONSTANTS = RunUnknownConstants()


def unknown_in_reach(run: RunFolder, log: Log, arm: RobotSpheres) -> UnknownSpace:
    """Find the unknown voxels of the box that an arm can reach, from at most 40 frames of the run.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    chain = arm.robot.chain
    q = np.random.default_rng(0).uniform(chain.lower, chain.upper, (CONSTANTS.samples, len(chain)))
    centers = arm.centers(q).reshape(-1, 3)
    box = np.array([centers.min(axis=0), centers.max(axis=0)])
    voxel = max(CONSTANTS.voxel, float((np.prod(box[1] - box[0]) / CONSTANTS.max_voxels) ** (1 / 3)))
    return find_unknown(box, voxel, raw_views(run, log, masked=np.nan)[1])


def obstacles(
    space: UnknownSpace,
    policy: UnknownPolicy,
    arm: RobotSpheres,
    occupied: ArrayLike,
    *,
    margin: float = 0.0,
    n_sigma: float = 2.0,
) -> GaussianModel:
    """Return the solids of unknown space under a policy, without the volume of the arm where it is known to be.

    The arm fills space that no camera sees, and is there without a collision. From there it cannot move farther into
    unknown space: the rest of it is solid around that volume too.

    Args:
        space: unknown space.
        policy: treatment of unknown space.
        arm: the arm.
        occupied: (C, J) configurations at which the arm is or was [rad or m].
        margin: clearance that a plan keeps [m]. Solids within it of the arm are left out too, because a plan could not
            start there.
        n_sigma: surface of the solids, in standard deviations.
    """
    q = np.atleast_2d(np.asarray(occupied, dtype=np.float64))
    centers, radii = arm.centers(q).reshape(-1, 3), np.tile(arm.spheres.radii + margin + CONSTANTS.slack, len(q))
    return space.without(np.c_[centers, radii]).solids(n_sigma, policy=policy)
