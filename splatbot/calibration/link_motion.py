"""Poses of a link of an arm at the times of views, from joints or as recorded."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from splatbot.collision import RobotSpheres
from splatbot.errors import InputError
from splatbot.protocols import RobotKinematics

Array = NDArray[np.float64]

_BEYOND = 0.2  # [rad or m] beyond its limits that a measured joint position may be
_AROUND = 2.0  # [s] of a record before and after the views that are kept


class LinkMotion(Protocol):
    """Poses of a link: one for each view, or recorded over time and interpolated at the times of the views."""

    @property
    def offsets(self) -> tuple[str, ...]:
        """Names of the joints whose offsets change the poses; empty for recorded poses."""
        ...

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each offset: "rad" or "m"."""
        ...

    @property
    def stamps(self) -> Array | None:
        """Times (N,) of the record [s], None if there is one pose for each view."""
        ...

    def __len__(self) -> int: ...

    def poses(self, offsets: Array, delay: float) -> Array:
        """Compute T_base_link (V, 4, 4) with joint offsets (J,) [rad or m], ``delay`` [s] after the views."""
        ...

    def seen_at(self, views: Array, delay: float) -> LinkMotion:
        """Return the motion at views (V,) [s], when the stamps of the record are ``delay`` [s] ahead of those."""
        ...

    def select(self, rows: NDArray[np.intp]) -> LinkMotion:
        """Return the motion at the views ``rows``."""
        ...


@dataclass(frozen=True, eq=False)
class JointLinkMotion:
    """Motion of a link by its joints.

    Args:
        arm: kinematics of the arm.
        joints: (N, J) joint positions [rad or m].
        link: index of the link, 1 to J.
        stamps: (N,) times of the joint positions [s]; None if each row belongs to one view.
        views: (V,) times of the views [s]; None before :meth:`seen_at`.
    """

    arm: RobotSpheres
    joints: Array
    link: int
    stamps: Array | None = None
    views: Array | None = None

    @property
    def offsets(self) -> tuple[str, ...]:
        """Names of the joints before the link."""
        return self.arm.robot.chain.names[: self.link]

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each offset."""
        return tuple("m" if prismatic else "rad" for prismatic in self.arm.robot.chain.prismatic[: self.link])

    def __len__(self) -> int:
        return len(self.joints if self.views is None else self.views)

    def poses(self, offsets: Array, delay: float) -> Array:
        """Implement :class:`LinkMotion`."""
        q = self.joints.copy()
        if self.stamps is not None and self.views is not None:
            q = np.column_stack([np.interp(self.views + delay, self.stamps, column) for column in self.joints.T])
        q[:, : self.link] += offsets
        return np.asarray(self.arm.forward(q)[:, self.link])

    def seen_at(self, views: Array, delay: float) -> JointLinkMotion:
        """Implement :class:`LinkMotion`."""
        near, stamps, times = _relative_times(self.stamps, views, delay)
        return replace(self, joints=self.joints[near], stamps=stamps, views=times)

    def select(self, rows: NDArray[np.intp]) -> JointLinkMotion:
        """Implement :class:`LinkMotion`."""
        if self.views is None:
            return replace(self, joints=self.joints[rows])
        return replace(self, views=self.views[rows])


@dataclass(frozen=True, eq=False)
class PoseLinkMotion:
    """Motion of a link by recorded poses.

    Args:
        T_base_link: (N, 4, 4) [m].
        stamps: (N,) times of the poses [s]; None if each pose belongs to one view.
        views: (V,) times of the views [s]; None before :meth:`seen_at`.
    """

    T_base_link: Array
    stamps: Array | None = None
    views: Array | None = None
    offsets: tuple[str, ...] = ()
    units: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.T_base_link if self.views is None else self.views)

    def poses(self, offsets: Array, delay: float) -> Array:
        """Implement :class:`LinkMotion`."""
        if self.stamps is None or self.views is None:
            return self.T_base_link
        times = np.clip(self.views + delay, self.stamps[0], self.stamps[-1])
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, :3, :3] = self._rotations(times).as_matrix()
        T[:, :3, 3] = np.column_stack([np.interp(times, self.stamps, x) for x in self.T_base_link[:, :3, 3].T])
        return T

    @cached_property
    def _rotations(self) -> Any:
        return Slerp(self.stamps, Rotation.from_matrix(self.T_base_link[:, :3, :3]))

    def seen_at(self, views: Array, delay: float) -> PoseLinkMotion:
        """Implement :class:`LinkMotion`."""
        near, stamps, times = _relative_times(self.stamps, views, delay)
        return replace(self, T_base_link=self.T_base_link[near], stamps=stamps, views=times)

    def select(self, rows: NDArray[np.intp]) -> PoseLinkMotion:
        """Implement :class:`LinkMotion`."""
        if self.views is None:
            return replace(self, T_base_link=self.T_base_link[rows])
        return replace(self, views=self.views[rows])


def _relative_times(stamps: Array | None, views: Array, delay: float) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return which rows of a record are near the views, their stamps, and the views, all from the first view on.

    Differences of stamps like 1.7e9 s keep their microseconds only near 0.
    """
    if stamps is None:
        raise InputError("has no stamps.", field="motion", hint="give the times of the record")
    times, at = stamps - (views[0] + delay), views - views[0]
    near = (times > -_AROUND) & (times < at[-1] + _AROUND)
    return near, times[near], at


def check_joints(robot: RobotKinematics, joints: Array, *, file: str) -> None:
    """Check that joint positions (N, >= J) [rad or m] can be those of an arm; columns of a gripper may follow.

    Raises:
        InputError: there are too few columns, a value is not finite, or a position is far beyond its limits.
    """
    chain, count = robot.chain, len(robot.chain)
    if joints.ndim != 2 or joints.shape[1] < count:
        found = joints.shape[1] if joints.ndim == 2 else 0
        hint = "give the joints of this robot, or the robot of these joints"
        raise InputError(f"has {found} joints, {robot.name} has {count}.", file=file, field="joints", hint=hint)
    q = joints[:, :count]
    if not np.isfinite(q).all():
        raise InputError("has values that are not finite.", file=file, field="joints", hint="remove these lines")
    beyond = np.maximum(chain.lower - q, q - chain.upper).max(axis=0)
    if beyond.max() > _BEYOND:
        k = int(beyond.argmax())
        worst = float(q[np.abs(q[:, k]).argmax(), k])
        raise InputError(
            f"{chain.names[k]} is {worst:.4g}, its limits are {chain.lower[k]:.4g} to {chain.upper[k]:.4g}.",
            file=file,
            field="joints",
            hint=f"give radians, in the order of the joints of {robot.name}: {', '.join(chain.names)}",
        )
