"""Poses of a link of an arm at the times of views, from joints or as recorded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from splatbot.errors import InputError
from splatbot.protocols import KinematicChain

Array = NDArray[np.float64]

_BEYOND = 0.2  # [rad or m] beyond its limits that a measured joint position may be


class LinkMotion(Protocol):
    """Poses of a link at the times of the views."""

    @property
    def offsets(self) -> tuple[str, ...]:
        """Names of the joints whose offsets change the poses; empty for recorded poses."""
        ...

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each offset: "rad" or "m"."""
        ...

    def __len__(self) -> int: ...

    def poses(self, offsets: Array, delay: float) -> Array:
        """Compute T_base_link (V, 4, 4) with joint offsets (J,) [rad or m], ``delay`` [s] after the stamps."""
        ...

    def select(self, rows: NDArray[np.intp]) -> LinkMotion:
        """Return the motion at the views ``rows``."""
        ...


@dataclass(frozen=True, eq=False)
class JointLinkMotion:
    """Motion of a link by its joints.

    Args:
        chain: joints of the arm.
        joints: (N, J) joint positions [rad or m].
        link: index of the link, 1 to J.
        stamps: (N,) times of the joint positions [s] near 0; None if each row belongs to one view.
        at: (V,) times of the views [s].
    """

    chain: KinematicChain
    joints: Array
    link: int
    stamps: Array | None = None
    at: Array | None = None

    @property
    def offsets(self) -> tuple[str, ...]:
        """Names of the joints before the link."""
        return self.chain.names[: self.link]

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each offset."""
        return tuple("m" if prismatic else "rad" for prismatic in self.chain.prismatic[: self.link])

    def __len__(self) -> int:
        return len(self.joints if self.at is None else self.at)

    def poses(self, offsets: Array, delay: float) -> Array:
        """Implement :class:`LinkMotion`."""
        q = self.joints
        if self.stamps is not None and self.at is not None:
            q = np.column_stack([np.interp(self.at + delay, self.stamps, column) for column in self.joints.T])
        return link_poses(self.chain, q[:, : self.link] + offsets, self.link)

    def select(self, rows: NDArray[np.intp]) -> JointLinkMotion:
        """Implement :class:`LinkMotion`."""
        if self.at is None:
            return JointLinkMotion(self.chain, self.joints[rows], self.link)
        return JointLinkMotion(self.chain, self.joints, self.link, self.stamps, self.at[rows])


@dataclass(frozen=True, eq=False)
class PoseLinkMotion:
    """Motion of a link by recorded poses.

    Args:
        T_base_link: (N, 4, 4) [m].
        stamps: (N,) times of the poses [s] near 0; None if each pose belongs to one view.
        at: (V,) times of the views [s].
    """

    T_base_link: Array
    stamps: Array | None = None
    at: Array | None = None

    @property
    def offsets(self) -> tuple[str, ...]:
        """No names: the joints are not known."""
        return ()

    @property
    def units(self) -> tuple[str, ...]:
        """No units."""
        return ()

    def __len__(self) -> int:
        return len(self.T_base_link if self.at is None else self.at)

    def poses(self, offsets: Array, delay: float) -> Array:
        """Implement :class:`LinkMotion`."""
        if self.stamps is None or self.at is None:
            return self.T_base_link
        times = np.clip(self.at + delay, self.stamps[0], self.stamps[-1])
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, :3, :3] = self._rotations(times).as_matrix()
        T[:, :3, 3] = np.column_stack([np.interp(times, self.stamps, x) for x in self.T_base_link[:, :3, 3].T])
        return T

    @cached_property
    def _rotations(self) -> Any:
        return Slerp(self.stamps, Rotation.from_matrix(self.T_base_link[:, :3, :3]))

    def select(self, rows: NDArray[np.intp]) -> PoseLinkMotion:
        """Implement :class:`LinkMotion`."""
        return (
            PoseLinkMotion(self.T_base_link[rows])
            if self.at is None
            else PoseLinkMotion(self.T_base_link, self.stamps, self.at[rows])
        )


def check_joints(chain: KinematicChain, joints: Array, *, robot: str, file: str) -> None:
    """Check that joint positions (N, >= J) [rad or m] can be those of an arm; columns of a gripper may follow.

    Raises:
        InputError: there are too few columns, a value is not finite, or a position is far beyond its limits.
    """
    count = len(chain)
    if joints.ndim != 2 or joints.shape[1] < count:
        found = joints.shape[1] if joints.ndim == 2 else 0
        hint = "give the joints of this robot, or the robot of these joints"
        raise InputError(f"has {found} joints, {robot} has {count}.", file=file, field="joints", hint=hint)
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
            hint=f"give radians, in the order of the joints of {robot}: {', '.join(chain.names)}",
        )


def link_poses(chain: KinematicChain, q: Array, link: int) -> Array:
    """Compute T_base_link (V, 4, 4) of link ``link`` at joint positions (V, >= link) [rad or m]."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    for k in range(link):
        step = np.tile(np.eye(4), (len(q), 1, 1))
        if chain.prismatic[k]:
            step[:, 2, 3] = q[:, k]
        else:
            c, s = np.cos(q[:, k]), np.sin(q[:, k])
            step[:, 0, 0], step[:, 0, 1], step[:, 1, 0], step[:, 1, 1] = c, -s, s, c
        T = T @ chain.T_before_joint[k] @ step
    return T
