"""Parts that the readers of robot descriptions share: missing limits, the arm's end, plausible sizes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatbot.errors import FormatError, InputError
from splatbot.geometry import so3_exp
from splatbot.protocols import Array
from splatbot.robots.cover import proof_size
from splatbot.robots.joints import Joint, chain_of
from splatbot.robots.robot import RobotModel
from splatbot.robots.shapes import Shape


@dataclass(frozen=True)
class DescriptionConstants:
    """Constants of readers: limits that a file lacks, and bounds of plausible sizes.

    Args:
        velocity: [rad/s or m/s] limit of the velocity of a joint without one. A larger one makes motions faster than
            the arm may bear.
        acceleration_per_velocity: [1/s] ratio of the limits of acceleration and velocity. The joint reaches its
            velocity within a fifth of a second.
        jerk_per_velocity: [1/s²] ratio of the limits of jerk and velocity. The joint reaches its acceleration within a
            tenth of a second.
        longest_link: length of a moving link, relative to the reach of the arm, above which its scale is wrong.
        longest_base: the same of the base, which may be a table or a vehicle.
        shortest_links: length of the longest link, relative to the reach, below which the scale is wrong.
        most_triangles: of all meshes together; it bounds memory.
        slack: of the spheres, relative to the reach of the arm, if none is given.
        good_spheres: number of spheres up to which a slack is kept.
        most_spheres: that collision checks take (kMostSpheres in arm_kernels.hpp).
        spheres_of_slack: exponent p of the number of spheres, which is proportional to slack^-p about, before two fits
            measure it. It is 2.6 for printed parts with ribs and 0.5 for long capsules; too small a value overshoots.
        most_pieces: pieces of the surface in the proof of the spheres, at most; it bounds memory and time.
        longest_finger: moving joints of a branch that may be a finger and not an arm, at most.
    """

    velocity: float = 1.0
    acceleration_per_velocity: float = 5.0
    jerk_per_velocity: float = 50.0
    longest_link: float = 1.5
    longest_base: float = 10.0
    shortest_links: float = 0.02
    most_triangles: int = 2_000_000
    slack: float = 0.02
    good_spheres: int = 256
    most_spheres: int = 640
    spheres_of_slack: float = 2.6
    most_pieces: int = 10_000_000
    longest_finger: int = 3


CONSTANTS = DescriptionConstants()
_FITS = 6  # attempts to reach the number of spheres


@dataclass(frozen=True)
class Reading:
    """Robot of a file, and the assumptions that replace missing values."""

    robot: RobotModel
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class NamedShape:
    """A shape, and the name of the link or file that an error of its size names."""

    name: str
    shape: Shape


def joint(
    name: str, T: Array, limits: tuple[float, float], velocity: float, effort: float, *, prismatic: bool
) -> Joint:
    """Build a joint with the limits of acceleration and jerk that no description has.

    Args:
        name: of the joint.
        T: (4, 4) pose of its frame at 0 in the frame of the previous link [m].
        limits: lower and upper [rad or m].
        velocity: largest magnitude [rad/s or m/s].
        effort: largest torque [Nm] or force [N].
        prismatic: True for a translation.

    Raises:
        InputError: a limit is not finite, or upper is below lower.
    """
    acceleration = CONSTANTS.acceleration_per_velocity * velocity
    return Joint(name, T, *limits, velocity, acceleration, CONSTANTS.jerk_per_velocity * velocity, effort, prismatic)


def default_tip(children: Mapping[str, Sequence[str]], moving: Iterable[str], root: str, file: Path) -> str:
    """Find the last link of the arm: walk outwards from the root, and stop where fingers branch off.

    Args:
        children: links that each link carries.
        moving: links whose joint moves.
        root: first link.
        file: for errors.

    Returns:
        the link at which two or more branches of at most ``longest_finger`` moving joints begin, or the outermost one.

    Raises:
        FormatError: two branches have as many joints as an arm: several arms.
    """
    moves = set(moving)

    def most(link: str) -> int:
        """Return the largest number of moving joints on a path that begins with the joint of a link."""
        return (link in moves) + max((most(child) for child in children.get(link, ())), default=0)

    at = root
    while True:
        branches = sorted((c for c in children.get(at, ()) if most(c) > 0), key=most, reverse=True)
        if not branches:
            plain = children.get(at, ())
            if len(plain) != 1:
                return at
            at = plain[0]  # the fixed links behind the last joint, as a flange
            continue
        longest = most(branches[0])
        if len(branches) > 1:
            if longest <= CONSTANTS.longest_finger:
                return at
            if most(branches[1]) == longest:
                raise FormatError(
                    f"has several arms, which begin with {', '.join(branches[:4])}.", file=file, hint="choose by --tip"
                )
        at = branches[0]


def distinct(shapes: Iterable[NamedShape]) -> list[NamedShape]:
    """Drop meshes that stand twice on a link, as visual and as collision geometry."""
    found: list[NamedShape] = []
    for named in shapes:
        own = [other.shape.triangles() for other in found if other.shape.link == named.shape.link]
        if not any(np.array_equal(named.shape.triangles(), other) for other in own):
            found.append(named)
    return found


def simplified(robot: RobotModel, may_grow: bool) -> RobotModel:
    """Return the robot with as few spheres as collision checks take, by a larger slack if it may grow.

    Raises:
        InputError: there are too many spheres.
    """
    count, exponent = len(robot.spheres()), CONSTANTS.spheres_of_slack
    for _ in range(_FITS if may_grow else 0):
        if count <= CONSTANTS.good_spheres:
            break
        growth = (1.1 * count / CONSTANTS.good_spheres) ** (1 / exponent)
        robot, before = replace(robot, slack=robot.slack * growth), count
        count = len(robot.spheres())
        exponent = float(np.clip(np.log(before / count) / np.log(growth), 0.25, 4.0))
    if count > CONSTANTS.most_spheres:
        raise InputError(
            f"needs {count} spheres within {1e3 * robot.slack:.3g} mm, above {CONSTANTS.most_spheres}.",
            field=robot.name, hint="give a larger --slack, or simpler collision meshes",
        )  # fmt: skip
    return robot


def checked_slack(
    shapes: Sequence[NamedShape], joints: Sequence[Joint], T_link_tcp: Array, slack: float | None, file: Path
) -> float:
    """Return the slack [m] of an arm whose sizes are plausible: the given one, or a share of the reach.

    Raises:
        FormatError: a size is implausible, or the surface is too large for the slack.
    """
    _check_sizes(shapes, joints, T_link_tcp, file)
    chosen = CONSTANTS.slack * max(chain_of(joints).reach(T_link_tcp), 0.05) if slack is None else slack
    _check_work(shapes, chosen, file)
    return chosen


def _check_work(shapes: Sequence[NamedShape], slack: float, file: Path) -> None:
    """Refuse a cover whose proof would need too many pieces of the surface.

    Raises:
        FormatError: it would; the hint names the smallest slack that is possible.
    """
    if not slack > 0:
        return  # cover() refuses it
    areas = [np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2 for t in
             (named.shape.triangles() for named in shapes)]  # fmt: skip
    pieces = sum(areas) / proof_size(slack) ** 2 * 2
    if pieces > CONSTANTS.most_pieces:
        least = slack * np.sqrt(pieces / CONSTANTS.most_pieces)
        raise FormatError(
            f"has {sum(areas):.3g} m² of surface, too much for spheres within {1e3 * slack:.3g} mm.",
            file=file, hint=f"give --slack {np.ceil(1e3 * least) / 1e3:g} or more, if the arm is as large as that",
        )  # fmt: skip


def _check_sizes(shapes: Sequence[NamedShape], joints: Sequence[Joint], T_link_tcp: Array, file: Path) -> None:
    """Refuse links that are far longer or shorter than the arm's kinematics, as meshes in millimetres are.

    Args:
        shapes: of all links.
        joints: of the arm.
        T_link_tcp: (4, 4) pose of the tool on the last link [m].
        file: for errors.

    Raises:
        FormatError: a size is implausible, or the meshes have too many triangles.
    """
    reach = chain_of(joints).reach(T_link_tcp)
    triangles, longest = 0, 0.0
    for named in shapes:
        corners = named.shape.triangles()
        triangles += len(corners)
        length = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
        longest = max(longest, length)
        most = CONSTANTS.longest_link if named.shape.link > 0 else CONSTANTS.longest_base
        if reach > 0 and length > most * reach:
            raise FormatError(
                f"is {length:.3g} m long, but the arm reaches {reach:.3g} m.",
                file=file,
                field=named.name,
                hint=_scale_hint(length / reach),
            )
    if triangles > CONSTANTS.most_triangles:
        raise FormatError(
            f"has {triangles} triangles.", file=file, hint=f"simplify its meshes to {CONSTANTS.most_triangles} or fewer"
        )
    if reach > 0 and shapes and longest < CONSTANTS.shortest_links * reach:
        raise FormatError(
            f"has no link longer than {1e3 * longest:.3g} mm, but the arm reaches {reach:.3g} m.",
            file=file,
            hint="its meshes are scaled twice: remove the scale",
        )


def _scale_hint(ratio: float) -> str:
    """Return the scale to give to a link that is longer than the arm by a ratio."""
    if ratio > 50:
        return 'the mesh is in millimetres: give scale="0.001 0.001 0.001"'
    return "compare the unit of the mesh with the URDF's metres (an inch is 0.0254), and give it a scale"


def z_to(axis: Array) -> Array:
    """Return the rotation (3, 3) of smallest angle that maps z to a unit vector."""
    c = float(axis[2])
    if c < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    v = np.cross([0.0, 0.0, 1.0], axis)
    s = float(np.linalg.norm(v))
    return so3_exp(v / s * np.arctan2(s, c)) if s > 0 else np.eye(3)
