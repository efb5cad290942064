"""Transforms of TF: poses of named frames in their parents, as messages of /tf and /tf_static hold them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from splatbot.logs.ros_frames import seconds_of
from splatbot.logs.ros_types import Message

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
