"""Transforms of TF, live or of a recording, interpolated at the time of an image."""

from __future__ import annotations

import bisect
import math
import threading
import time
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, pose_from_quat
from splatbot.logs.joints import MAX_GAP
from splatbot.logs.ros_transforms import StampedTransform
from splatbot.mapping.selfmask import JointsUnknownError
from splatbot.protocols import Array

MAX_FRAMES = 512
MAX_TRANSFORMS = 100_000  # of moving frames: ten links at 1 kHz over the kept time
_KEPT_S = 10.0  # [s] of transforms
_SET_BACK_S = 0.5  # [s] by which a transform may be older than the newest one of its frame
_NO_TF = "publish their TF, or joint states, with T_link_camera in scene.yaml"


@dataclass(eq=False)
class _Edge:
    """Poses (7,) of a frame in its parent, translation and unit quaternion, in the order of their stamps."""

    parent: str
    static: bool
    stamps: array[float] = field(default_factory=lambda: array("d"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def pose(self, index: int) -> NDArray[np.float64]:
        """Return the pose (7,) at an index, which may be -1 for the newest."""
        begin = index % len(self.stamps) * 7
        return np.array(self.values[begin : begin + 7])

    def insert(self, stamp: float, pose: Iterable[float]) -> None:
        """Insert a pose (7,) at its stamp [s]; it replaces one of the same stamp."""
        at = bisect.bisect_left(self.stamps, stamp)
        if at == len(self.stamps) or self.stamps[at] != stamp:
            self.stamps.insert(at, stamp)
            self.values[7 * at : 7 * at] = array("d", pose)
        else:
            self.values[7 * at : 7 * at + 7] = array("d", pose)

    def keep(self, seconds: float, most: int) -> None:
        """Keep the poses of the last seconds [s], and of these the newest ones."""
        old = max(bisect.bisect_left(self.stamps, self.stamps[-1] - seconds), len(self.stamps) - most)
        del self.stamps[:old], self.values[: 7 * old]

    def at(self, stamp: float) -> NDArray[np.float64] | None:
        """Interpolate the pose (7,) at a stamp [s]; None if a neighbour is more than 0.1 s away, or missing."""
        if self.static:
            return self.pose(-1)
        after = bisect.bisect_left(self.stamps, stamp)
        if after < len(self.stamps) and self.stamps[after] == stamp:
            return self.pose(after)
        if not 0 < after < len(self.stamps):
            return None
        before, later = self.stamps[after - 1], self.stamps[after]
        if max(stamp - before, later - stamp) > MAX_GAP:
            return None
        return _between(self.pose(after - 1), self.pose(after), (stamp - before) / (later - before))


class TransformBuffer:
    """Transforms of clients, or of a recording; any thread adds to it, and mapping reads it.

    It holds 512 frames at most. If a clock is set back, the transforms of moving frames are forgotten.

    Args:
        kept_s: time [s] for which transforms of moving frames are kept.
        most: number of transforms that are kept.
    """

    def __init__(self, *, kept_s: float = _KEPT_S, most: int = MAX_TRANSFORMS) -> None:
        self._kept_s, self._most = kept_s, most
        self._edges: dict[str, _Edge] = {}
        self._changed = threading.Condition()

    def __len__(self) -> int:
        """Return the number of kept transforms."""
        with self._changed:
            return sum(len(edge.stamps) for edge in self._edges.values())

    def add(self, transforms: Iterable[StampedTransform]) -> None:
        """Add transforms. One that is no pose, or of one frame too many, is left out, and its frame becomes stale."""
        with self._changed:
            for one in transforms:
                if one.is_usable() and (one.child in self._edges or len(self._edges) < MAX_FRAMES):
                    self._add(one)
            self._changed.notify_all()

    def _add(self, one: StampedTransform) -> None:
        edge = self._edges.get(one.child)
        if edge is not None and edge.stamps[-1] - one.stamp > _SET_BACK_S and not (edge.static or one.static):
            self._edges = {child: known for child, known in self._edges.items() if known.static}
            edge = None
        if edge is None or one.static or edge.static or edge.parent != one.parent:
            edge = self._edges[one.child] = _Edge(one.parent, one.static)
        norm = math.hypot(*one.quat)
        edge.insert(one.stamp, (*one.translation, *(part / norm for part in one.quat)))
        edge.keep(self._kept_s, self._most // len(self._edges))

    def poses(self, target: str, sources: Sequence[str], stamp: float, wait_s: float = 0.0) -> Array:
        """Interpolate T_target_source (N, 4, 4) [m] of N frames at a stamp [s]; wait up to ``wait_s`` [s] for them.

        Translations are interpolated linearly and rotations at constant angular velocity (slerp).

        Raises:
            JointsUnknownError: a frame is unknown or not connected, or a transform between the frames is missing or
                stale: its neighbour before or after the stamp is more than 0.1 s away.
        """
        deadline = time.monotonic() + wait_s
        with self._changed:
            while True:
                try:
                    return self._poses(target, sources, stamp)
                except JointsUnknownError:
                    if (left := deadline - time.monotonic()) <= 0:
                        raise
                self._changed.wait(left)

    def newest(self, target: str, source: str) -> Array | None:
        """Return the newest T_target_source (4, 4) [m]; None if no transforms connect the frames."""
        with self._changed:
            common = self._common(target, source)
            if common is None:
                return None
            up, down = self._down(target, common), self._down(source, common)
            return _relative(up, down, {child: self._edges[child].pose(-1) for child in (*up, *down)})

    def fixed(self, target: str, source: str) -> Array | None:
        """Return T_target_source (4, 4) [m] by static transforms alone; None if these do not connect the frames."""
        with self._changed:
            common = self._common(target, source)
            if common is None:
                return None
            way = (*self._down(target, common), *self._down(source, common))
            return self.newest(target, source) if all(self._edges[child].static for child in way) else None

    def carrier(self, frame: str, links: Sequence[str]) -> str | None:
        """Return the first of the links on the way from a frame up to its root; None if no link carries the frame."""
        with self._changed:
            return next((name for name in self._up(frame) if name in links), None)

    def _poses(self, target: str, sources: Sequence[str], stamp: float) -> Array:
        lost = [source for source in sources if self._common(target, source) is None]
        if lost:
            raise self._unconnected(target, lost)
        known: dict[str, NDArray[np.float64]] = {}
        found = np.empty((len(sources), 4, 4))
        for row, source in zip(found, sources, strict=True):
            common = self._common(target, source)
            up, down = self._down(target, common), self._down(source, common)
            for child in (*up, *down):
                if child not in known:
                    known[child] = self._at(child, stamp)
            row[:] = _relative(up, down, known)
        return found

    def _at(self, child: str, stamp: float) -> NDArray[np.float64]:
        edge = self._edges[child]
        pose = edge.at(stamp)
        if pose is None:
            known = f"the newest is {stamp - edge.stamps[-1]:+.3f} s before it"
            hint = f"publish /tf with the images, with stamps of their clock, at {1 / MAX_GAP:.0f} Hz or more"
            message = f"TF of {child} at {stamp:.3f} s is missing or stale: {known}."
            raise JointsUnknownError(message, field="tf", hint=hint)
        return pose

    def _unconnected(self, target: str, lost: list[str]) -> JointsUnknownError:
        frames = {*self._edges, *(edge.parent for edge in self._edges.values())}
        missing = [name for name in (target, *lost) if name not in frames]
        if missing:
            like = sorted(name for name in frames if any(name.endswith(lack) for lack in missing))
            hint = f"there are {', '.join(like[:9])}: give that tf_prefix" if like else _NO_TF
            return JointsUnknownError(f"TF has no frame {', '.join(missing)}.", field="tf", hint=hint)
        hint = "publish the transforms between them, also on /tf_static"
        return JointsUnknownError(f"TF does not connect {', '.join(lost)} with {target}.", field="tf", hint=hint)

    def _up(self, frame: str) -> Iterator[str]:
        """Yield a frame, its parent and so on; a loop ends where it closes."""
        seen: set[str] = set()
        while frame not in seen:
            yield frame
            seen.add(frame)
            frame = self._edges[frame].parent if frame in self._edges else frame

    def _common(self, a: str, b: str) -> str | None:
        """Return the lowest frame above two frames, which may be one of them; None if nothing connects them."""
        above = set(self._up(a))
        return next((name for name in self._up(b) if name in above), None)

    def _down(self, frame: str, ancestor: str | None) -> tuple[str, ...]:
        """Return the frames from below an ancestor down to a frame."""
        path: list[str] = []
        for name in self._up(frame):
            if name == ancestor:
                break
            path.append(name)
        return tuple(reversed(path))


def _relative(up: Sequence[str], down: Sequence[str], poses: dict[str, NDArray[np.float64]]) -> Array:
    """Return T_target_source (4, 4) from the frames below the common ancestor to the target and to the source."""
    return np.asarray(inverse(_chained(up, poses)) @ _chained(down, poses))


def _chained(children: Sequence[str], poses: dict[str, NDArray[np.float64]]) -> Array:
    T = np.eye(4)
    for child in children:
        T = T @ pose_from_quat(poses[child][:3], poses[child][3:])
    return T


def _between(a: NDArray[np.float64], b: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Interpolate poses (7,): sin((1 - s) θ) p + sin(s θ) q over sin θ along the shorter arc of the quaternions."""
    p, q = a[3:], b[3:] if a[3:] @ b[3:] >= 0 else -b[3:]
    angle = 2.0 * np.arctan2(np.linalg.norm(q - p), np.linalg.norm(q + p))
    shares = np.array([1.0 - share, share])
    if angle > 1e-9:
        shares = np.sin(shares * angle) / np.sin(angle)
    return np.concatenate([(1.0 - share) * a[:3] + share * b[:3], shares[0] * p + shares[1] * q])
