"""Interfaces of a robot to the core: kinematics, spheres of its links, controller, gripper, camera."""

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
LIMIT_SLACK = 1e-6
"""Excess [rad or m] of a joint over a limit that is no violation; encoders at a hard stop read such values."""


@dataclass(frozen=True, eq=False)
class KinematicChain:
    """Serial arm of J joints. Link 0 is the base; link k moves with joint k - 1. Each joint axis is z of its frame.

    Args:
        names: names of the joints.
        T_before_joint: (J, 4, 4) pose of each joint's frame at 0 in the frame of the previous link [m].
        prismatic: (J,), True for a prismatic joint, False for a revolute one.
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

    def beyond_limits(self, q: Array) -> tuple[int, float] | None:
        """Return the joint of ``q`` (J,) that exceeds its limits most, and the excess [rad or m]; None within them."""
        excess = np.maximum(self.lower - q, q - self.upper)
        joint = int(np.argmax(excess))
        return (joint, float(excess[joint])) if excess[joint] > LIMIT_SLACK else None

    def reach(self, T_link_tcp: Array) -> float:
        """Return the distance [m] from the first joint to the tool when all links are in line: an upper bound.

        Args:
            T_link_tcp: (4, 4) pose of the tool on the last link [m].
        """
        steps = np.concatenate([self.T_before_joint[1:, :3, 3], np.asarray(T_link_tcp)[None, :3, 3]])
        travel = np.maximum(np.abs(self.lower), np.abs(self.upper))[self.prismatic]
        return float(np.linalg.norm(steps, axis=1).sum() + travel.sum())


@dataclass(frozen=True, eq=False)
class LinkSpheres:
    """Cover of an arm by S spheres, sorted by link.

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
    """Kinematics of an arm for collision checks and planning."""

    @property
    def name(self) -> str:
        """Name of the robot."""
        ...

    @property
    def chain(self) -> KinematicChain:
        """Joints and their limits."""
        ...

    @property
    def home(self) -> Array:
        """Posture (J,) [rad or m] in which the arm waits."""
        ...

    @property
    def self_collision_pairs(self) -> NDArray[np.int32]:
        """(M, 2) links that may not touch each other."""
        ...

    def spheres(self, opening: float | None = None) -> LinkSpheres:
        """Return the spheres with the gripper at ``opening`` [m]. If None, the gripper is fully open."""
        ...


@dataclass(frozen=True)
class HandShape:
    """Two-finger hand as boxes in the tool frame, with flat pads that face each other and may have rounded ends.

    The hand approaches along z of the tool and closes along y; the origin of the tool is between the pads.

    Args:
        stroke: widest opening between the pads [m].
        width: width of a finger along x [m].
        thickness: thickness of a finger along y, outwards from its pad [m].
        tip: z of the finger tips [m].
        pad: z of the end of the flat part of the pads [m], below ``tip`` if the tips are rounded; may be negative.
        pad_width: width of the flat part along x [m]; 0 for round fingers.
        palm: distance of the palm behind the origin [m].
        palm_size: size of the palm along x and y [m].
        force: force between the fingers [N].
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
    """A robot that can grasp objects."""

    @property
    def hand(self) -> HandShape | None:
        """Fingers of the robot, or None."""
        ...

    @property
    def T_link_tcp(self) -> Array:
        """Pose (4, 4) of the tool on the last link [m]."""
        ...


class ArmWithHand(RobotKinematics, HasHand, Protocol):
    """An arm that can grasp objects."""


class MotionState(StrEnum):
    """State of a controller."""

    IDLE = "idle"
    MOVING = "moving"
    DONE = "done"
    STOPPED = "stopped"
    FAULT = "fault"


@dataclass(frozen=True, eq=False)
class Feedback:
    """Feedback of a controller at one period.

    Args:
        time: time since the start of the trajectory [s].
        position, velocity: (J,) measured values [rad or m, and per s].
        desired: (J,) position of the trajectory [rad or m].
        state: state of the controller.
        fault: cause of a fault; empty without a fault.
    """

    time: float
    position: Array
    velocity: Array
    desired: Array
    state: MotionState
    fault: str = ""

    @property
    def error(self) -> float:
        """Largest absolute difference between measured and desired position [rad or m]."""
        return float(np.abs(self.position - self.desired).max())


class TimedPath(Protocol):
    """A curve in joint space over time, which a controller follows."""

    @property
    def duration(self) -> float:
        """Duration [s]."""
        ...

    def reference(self, t: float) -> tuple[Array, Array]:
        """Return position and velocity (J,) at a time [s] since the start; outside, the arm rests at an end."""
        ...


@runtime_checkable
class Controller(Protocol):
    """An arm that follows certified motions: a driver, a twin, a recording, or a fake.

    Each :meth:`step` advances the time by one period; a driver waits for the period of its robot.
    """

    @property
    def period(self) -> float:
        """Control period [s]."""
        ...

    def send(self, motion: TimedPath) -> None:
        """Begin to follow a motion from where the arm is.

        Args:
            motion: a :class:`splatbot.planning.CertifiedMotion`; the controller refuses everything else.

        Raises:
            ControllerError: the motion is not certified or begins elsewhere, or the arm is at fault or moving.
        """
        ...

    def step(self) -> Feedback:
        """Let one period pass."""
        ...

    def stop(self) -> None:
        """Stop the arm; the command takes effect at the next step at the latest."""
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
        """Move towards an opening [m], with at most a force [N] and a speed [m/s] of the opening.

        Raises:
            InputError: a value is out of range.
        """
        ...

    def moving(self) -> bool:
        """Return whether the fingers move."""
        ...

    def opening(self) -> float:
        """Return the distance between the fingers [m]."""
        ...

    def holds(self) -> bool:
        """Return whether an object keeps the fingers from the commanded opening."""
        ...

    def stop(self) -> None:
        """Stop the fingers."""
        ...


@runtime_checkable
class FrameSource(Protocol):
    """A free-running camera: frames arrive at their times and are dropped if no client reads them."""

    @property
    def name(self) -> str:
        """Display name."""
        ...

    @property
    def uri(self) -> str:
        """URI that opens the camera."""
        ...

    @property
    def dropped(self) -> int:
        """Number of frames that a slow reader or the transfer lost."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames from now on.

        Raises:
            DeviceError: the device is gone.
        """
        ...

    def close(self) -> None:
        """End the stream."""
        ...
