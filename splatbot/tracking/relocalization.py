"""Finding the camera again once it is lost: among all keyframes, and believed only when a second frame agrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.tracking.budget import Budget
from splatbot.tracking.features import FeaturePose, Features, match_pose
from splatbot.tracking.hypothesis import ScoredHypothesis
from splatbot.tracking.nearby_keyframes import TrackedKeyframe, pose_distance
from splatbot.tracking.place_recognition import votes

Array = NDArray[np.float64]

_BEST = 4  # keyframes that a pose is sought in
_LEAST_INLIERS = 0.45  # of the residuals: stricter than on frames that follow a known one
# A camera does not move faster between the two frames that must agree.
_SLACK, _SPEED = 0.03, 2.0  # [m], [m/s]
_TURN_SLACK, _TURN_SPEED = 0.05, 4.0  # [rad], [rad/s]


@dataclass(frozen=True, eq=False)
class RelocalizationCandidate:
    """A pose found while lost, which the next frame has to confirm."""

    stamp: float
    T_world_camera: Array

    def agrees(self, stamp: float, T_world_camera: Array) -> bool:
        """Whether a camera can have moved from here to there in the time between."""
        moved, turned = pose_distance(self.T_world_camera, T_world_camera)
        dt = abs(stamp - self.stamp)
        return moved <= _SLACK + _SPEED * dt and turned <= _TURN_SLACK + _TURN_SPEED * dt


def is_sure(pose: ScoredHypothesis) -> bool:
    """Whether residuals and what the map shows from there agree well enough to begin anew."""
    health = pose.health
    return pose.verdict != "lost" and min(health.photometric_inliers, health.geometric_inliers) >= _LEAST_INLIERS


class PlaceSearch:
    """Compares a frame with all keyframes, over several frames where there is no time for all of them in one."""

    def __init__(self) -> None:
        self._next = 0

    def restart(self) -> None:
        """The camera is known: the next search begins with the latest keyframe."""
        self._next = 0

    def find(
        self, features: Features, keyframes: Sequence[TrackedKeyframe], camera: Camera, budget: Budget
    ) -> FeaturePose | None:
        """The pose from the keyframes that look most like the frame; None where none shares enough features.

        Begins with the latest keyframe at first, and where it stopped on the frame before; at least one is tried.
        """
        newest_first, found = keyframes[::-1], list[tuple[int, TrackedKeyframe]]()
        search = ("match all", float(_BEST * len(features) * max(len(view.features) for view in keyframes)))
        for tried in range(len(newest_first)):
            if tried and not budget.fits(("vote", 1), search):
                budget.skip("keyframes")
                break
            view = newest_first[self._next % len(newest_first)]
            self._next += 1
            with budget.run("vote", 1, under="recover"):
                found.append((int(votes(features, [view])[0]), view))
        found.sort(key=lambda pair: -pair[0])
        best = [view for _, view in found[:_BEST]]
        with budget.run("match all", len(features) * sum(len(view.features) for view in best), under="recover"):
            return match_pose(features, [(view.features, view.reference.T_world_camera) for view in best], camera)
