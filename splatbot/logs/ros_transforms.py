"""Transforms of TF: poses of named frames in their parents, as messages of /tf and /tf_static hold them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from splatbot.geometry import inverse, pose_from_quat
from splatbot.logs.ros_frames import seconds_of
from splatbot.logs.ros_types import Message
from splatbot.protocols import Array

TF, TF_STATIC = "/tf", "/tf_static"
_LONGEST_NAME = 256
_FARTHEST = 1e6  # [m]


@dataclass(frozen=True, eq=False)
class StampedTransform:
    """Pose of a frame in its parent at a time.

    Args:
        parent, child: names of the frames.
        stamp: [s].
        translation: (3,) [m].
        quat: (4,) wxyz.
        static: whether the pose holds at all times.
    """

    parent: str
    child: str
    stamp: float
    translation: Collection[float]
    quat: Collection[float]
    static: bool = False

    def pose(self) -> Array:
        """Return T_parent_child (4, 4) [m]."""
        return pose_from_quat(list(self.translation), np.array([*self.quat]) / math.hypot(*self.quat))

    def is_usable(self) -> bool:
        """Return whether the names are distinct and of a fair length, and the numbers finite and a pose."""
        names, numbers = (self.parent, self.child), (self.stamp, *self.translation, *self.quat)
        return (
            self.parent != self.child
            and all(0 < len(name) <= _LONGEST_NAME for name in names)
            and all(map(math.isfinite, numbers))
            and max(map(abs, self.translation)) <= _FARTHEST
            and any(self.quat)
        )


def static_transform(transforms: Iterable[StampedTransform], target: str, source: str) -> Array | None:
    """Return T_target_source (4, 4) [m] of two frames that static transforms connect, or None."""
    edges = {t.child: (t.parent, t.pose()) for t in transforms if t.static and t.is_usable()}

    def ancestors(frame: str) -> dict[str, Array]:
        found, T = {frame: np.eye(4)}, np.eye(4)
        while frame in edges and edges[frame][0] not in found:
            frame, pose = edges[frame]
            found[frame] = T = pose @ T
        return found

    of_target, of_source = ancestors(target), ancestors(source)
    common = next((frame for frame in of_source if frame in of_target), None)
    return None if common is None else inverse(of_target[common]) @ of_source[common]


def transforms_of(message: Message, *, static: bool) -> Iterator[StampedTransform]:
    """Yield the transforms of a TFMessage; names lose the slashes around them."""
    for one in message.transforms:
        t, q = one.transform.translation, one.transform.rotation
        yield StampedTransform(
            one.header.frame_id.strip("/"),
            one.child_frame_id.strip("/"),
            seconds_of(one.header.stamp),
            (t.x, t.y, t.z),
            (q.w, q.x, q.y, q.z),
            static,
        )
