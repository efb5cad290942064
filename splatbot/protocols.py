"""What the core asks of a robot: kinematics, spheres for its links, a controller, a gripper, a camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from splatbot.frame import Frame

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KinematicChain:
    """A serial arm of J joints. Link 0 is the base; link k moves with joint k - 1. Joints turn about, or move along, z.

    Args:
        names: of the joints.
        T_before_joint: (J, 4, 4), pose of each joint's frame at 0 in the frame of the link before [m].
        prismatic: (J,), the others are revolute.
        lower, upper: (J,) limits [rad or m].
        velocity, acceleration, jerk: (J,) largest magnitudes, in units of lower per s, s² and s³.
        effort: (J,) largest torque [Nm] or force [N].
    """

    names: tuple[str, ...]
    T_before_joint: Array
    prismatic: NDArray[np.bool_]
    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    effort: Array

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class LinkSpheres:
    """S spheres that cover an arm, sorted by link.

    Args:
        link: (S,) int32.
        centers: (S, 3) in the link's frame [m].
        radii: (S,) [m].
    """

    link: NDArray[np.int32]
    centers: Array
    radii: Array

    def __len__(self) -> int:
        return len(self.link)


@runtime_checkable
class RobotKinematics(Protocol):
    """An arm as collision checking and planning see it."""

    @property
    def name(self) -> str:
        """As the user calls it."""
        ...

    @property
    def chain(self) -> KinematicChain:
        """Joints and their limits."""
        ...

    @property
    def self_collision_pairs(self) -> NDArray[np.int32]:
        """(M, 2) links that may not touch each other."""
        ...

    def spheres(self, opening: float | None = None) -> LinkSpheres:
        """The spheres with the gripper opened by ``opening`` [m]; None: as wide as it goes."""
        ...


@dataclass(frozen=True)
class HandShape:
    """Two fingers with flat pads that close on each other, as boxes in the tool's frame whose pads may end round.

    The hand comes along the tool's z and closes along its y; the tool's origin is between the pads.

    Args:
        stroke: widest opening between the pads [m].
        width: of a finger along x [m].
        thickness: of a finger along y, outwards from its pad [m].
        tip: how far the fingers reach beyond the origin along z [m].
        pad: how far their pads are flat beyond it, below ``tip`` where the rest is rounded off [m]; may be negative.
        pad_width: how wide they are flat along x [m]; 0 of round fingers.
        palm: how far behind the origin the palm is [m].
        palm_size: of the palm along x and y [m].
        force: between the fingers [N].
    """

    stroke: float
    width: float
    thickness: float
    tip: float
    pad: float
    pad_width: float
    palm: float
    palm_size: tuple[float, float]
    force: float = 70.0


@runtime_checkable
class HasHand(Protocol):
    """A robot that can take hold of things."""

    @property
    def hand(self) -> HandShape | None:
        """Its fingers; None: it has none."""
        ...

    @property
    def T_link_tcp(self) -> Array:
        """(4, 4), the tool's frame on the last link."""
        ...


class MotionState(StrEnum):
    """What a controller is doing."""

    IDLE = "idle"
    MOVING = "moving"
    DONE = "done"
    STOPPED = "stopped"
    FAULT = "fault"


@dataclass(frozen=True, eq=False)
class Feedback:
    """What a controller tells of itself at one period.

    Args:
        time: since the trajectory began [s].
        position, velocity: (J,) measured [rad or m, and per s].
        desired: (J,) where the trajectory has it.
        state: what it is doing.
        fault: why it stands still, if it is at fault.
    """

    time: float
    position: Array
    velocity: Array
    desired: Array
    state: MotionState
    fault: str = ""

    @property
    def error(self) -> float:
        """The largest difference between measured and desired [rad or m]."""
        return float(np.abs(self.position - self.desired).max())


class TimedPath(Protocol):
    """What a controller follows: a curve in joint space with its time."""

    @property
    def duration(self) -> float:
        """[s]"""
        ...

    def reference(self, t: float) -> tuple[Array, Array]:
        """Position and velocity (J,) at a time [s] since the start; at rest at the ends before and after."""
        ...


@runtime_checkable
class Controller(Protocol):
    """An arm that follows trajectories: a driver, a twin, a recording, or a fake.

    Time passes by :meth:`step`, one period at a time; a driver's waits for its robot's.
    """

    @property
    def period(self) -> float:
        """Between two steps [s]."""
        ...

    def send(self, trajectory: TimedPath) -> None:
        """Begin to follow a trajectory from where the arm is.

        Raises:
            ControllerError: at fault, moving, or the trajectory begins elsewhere.
        """
        ...

    def step(self) -> Feedback:
        """Let one period pass."""
        ...

    def stop(self) -> None:
        """Come to rest; told at the latest by the next step."""
        ...

    def reset(self) -> None:
        """Clear a fault."""
        ...


@runtime_checkable
class Gripper(Protocol):
    """Fingers that open and close."""

    @property
    def stroke(self) -> float:
        """Widest opening [m]."""
        ...

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        """Go towards an opening [m], with at most a force [N] and a speed [m/s] of the opening."""
        ...

    def moving(self) -> bool:
        """Whether the fingers are still on their way."""
        ...

    def opening(self) -> float:
        """Between the fingers now [m]."""
        ...

    def holds(self) -> bool:
        """Whether something keeps the fingers from the opening that they were sent to."""
        ...

    def stop(self) -> None:
        """Stay where they are."""
        ...


@runtime_checkable
class FrameSource(Protocol):
    """A camera that runs by itself: frames come at their times and are lost when nobody takes them."""

    @property
    def name(self) -> str:
        """For people."""
        ...

    @property
    def uri(self) -> str:
        """What it is opened by."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """The frames from now on.

        Raises:
            DeviceError: the device is gone.
        """
        ...

    def close(self) -> None:
        """End the stream."""
        ...
