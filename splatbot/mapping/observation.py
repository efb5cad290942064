"""Observations: tracked frames as the tracking thread submits them to the mapper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.tracking.features import Features
from splatbot.tracking.health import Verdict
from splatbot.tracking.prepare import PreparedFrame


@dataclass(frozen=True)
class GraphLocation:
    """Where a tracked frame is in the pose graph.

    Args:
        keyframe: number of its reference keyframe: the nearest one that the trajectory leads to. If None, the map has
            no keyframes or loop closing is disabled. A frame of a further camera moves with this keyframe.
        revisits: whether the frame is at a place that the trajectory visited before, without a loop closure yet.
    """

    keyframe: int | None = None
    revisits: bool = False


_NOWHERE = GraphLocation()


@dataclass(frozen=True)
class Observation:
    """A tracked frame.

    Args:
        prepared: its images.
        T_world_camera: (4, 4), from tracking; without meaning for the verdict "lost".
        features: returns its keypoints. The mapping thread calls it once, if the frame becomes a keyframe.
        location: the frame in the pose graph.
        verdict: of tracking.
        held_out: whether the map must not use the frame.
        is_poor: whether a better frame of the same place is likely to come.
    """

    prepared: PreparedFrame
    T_world_camera: NDArray[np.float64]
    features: Callable[[], Features] = Features.none
    location: GraphLocation = _NOWHERE
    verdict: Verdict = "ok"
    held_out: bool = False
    is_poor: bool = False

    @property
    def camera_name(self) -> str:
        """Name of the camera; empty for the first one."""
        return self.prepared.frame.camera_name

    @property
    def stamp(self) -> float:
        """Time of the frame [s]."""
        return self.prepared.frame.stamp
