"""The place of a trajectory that is nearest to the map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.geometry import inverse, transform_points
from splatbot.planning.problem import link_words, place_words
from splatbot.planning.trajectory import JointTrajectory
from splatbot.protocols import Array


@dataclass(frozen=True)
class ClosestConstants:
    """Constants of the search for the nearest place.

    Args:
        moments: number of moments that are compared. The certificate, which is continuous, may be a little lower.
        cut: [m] distance beyond which nothing is near.
        close: [m] clearance beyond the margin below which a path is called close.
    """

    moments: int = 400
    cut: float = 0.5
    close: float = 0.002


CONSTANTS = ClosestConstants()


@dataclass(frozen=True, eq=False)
class ClosestApproach:
    """The nearest of the sampled moments of a trajectory.

    Args:
        time: of the moment [s].
        link: index of the nearest link.
        name: name of the joint that moves it.
        clearance: distance of that link from the map, less the margin [m].
        obstacle: name of the obstacle.
        point: (3,) its nearest point [m, world].
        at_base: (3,) the same in the frame of the base [m].
    """

    time: float
    link: int
    name: str
    clearance: float
    obstacle: str
    point: Array
    at_base: Array

    @property
    def close(self) -> bool:
        """Return whether the clearance is small compared with errors that the margin does not cover."""
        return self.clearance < CONSTANTS.close

    def __str__(self) -> str:
        away = f"{1e3 * self.clearance:.1f} mm beyond the margin from {self.obstacle}"
        place = place_words(self.at_base.tolist())
        moment = f"{link_words(self.link, self.name)} at {self.time:.2f} s"
        return f"of {CONSTANTS.moments} moments: {moment}, {away} at {place}"

    def to_dict(self) -> dict[str, Any]:
        """Return the moment as JSON values."""
        return {
            "time_s": round(self.time, 3),
            "link": self.link,
            "joint": self.name,
            "obstacle": self.obstacle,
            "clearance_m": self.clearance,
            "point_world_m": self.point.tolist(),
            "point_base_m": self.at_base.tolist(),
        }


def closest_approach(
    arm: RobotSpheres,
    field: GaussianCollisionField,
    trajectory: JointTrajectory,
    kind: Callable[[int], str] = lambda row: "the map",
) -> ClosestApproach | None:
    """Find the sampled moment at which an arm is nearest to a field; None if it is farther than 0.5 m.

    Args:
        arm: collision spheres of the robot, with the pose of its base and the margin.
        field: collision field of the map, and of unknown space.
        trajectory: the trajectory.
        kind: returns the name of the obstacle of a row of the field's model.
    """
    times = np.linspace(0.0, trajectory.duration, CONSTANTS.moments)
    q = trajectory.at(times).position
    found = arm.clearance(field, q, cut=CONSTANTS.cut)
    k = int(np.argmin(found.distance))
    if found.link[k] < 0:
        return None
    own = arm.spheres.link == found.link[k]
    near = field.clearance(arm.centers(q[k : k + 1])[0][own], cut=2 * CONSTANTS.cut)
    point = near.witness[int(np.argmin(near.distance - arm.spheres.radii[own]))]
    link = int(found.link[k])
    return ClosestApproach(
        time=float(times[k]),
        link=link,
        name=trajectory.names[link - 1] if link > 0 else "",
        clearance=float(found.distance[k]),
        obstacle=kind(int(found.index[k])),
        point=point,
        at_base=transform_points(inverse(arm.T_world_base), point),
    )
