"""Replay of a log's arm motion by the twin's arm: simulated tool poses against recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatbot.planning.ik import solve_ik
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.compare.recorded import ArmRecord, pose_gap
from splatbot.sim.contact_monitor import ContactEvent
from splatbot.sim.motion import MINIMUM_JERK_PEAK, JointMotion, minimum_jerk, motion_from_samples
from splatbot.sim.twin import Twin

BY_IK = "joints by IK, not recorded"
RECORDED = "recorded joints"


@dataclass(frozen=True)
class ReplayConstants:
    """Constants of the replay of a log."""

    static_spacing: float = 0.5
    """Median time [s] between frames from which the log is one of static poses. A shorter one makes a slow video stop
    at every frame."""
    rate: float = 250.0
    """Rate [Hz] of the samples of the motion between rests. A higher one follows the quintic more closely and takes
    more memory."""
    speed_share: float = 0.9
    """Largest speed [1] as a share of the joints' limits. A larger one replays faster, with larger tracking errors."""
    dwell: float = 0.1
    """Time [s] at rest at each pose until the tool pose is read. The controller settles in it; a shorter one measures
    its lag."""


CONSTANTS = ReplayConstants()


@dataclass(frozen=True)
class ToolError:
    """Difference of the simulated tool pose to the recorded one at one frame [m, rad]."""

    index: int
    position_m: float
    angle_rad: float


@dataclass(frozen=True)
class Replay:
    """Result of a replay.

    Args:
        source: ``BY_IK`` or ``RECORDED``.
        robot: the twin's arm.
        poses: number of poses in the log.
        reached: number of poses that the arm can reach.
        slower: factor by which the replay is slower than the log, to satisfy the arm's speed limits.
        errors: of the tool, by frame, without the first, where the arm starts.
        contacts: of the arm in the simulation.
        clearance: minimum simulated clearance of the arm [m].
        notes: limits of validity.
    """

    source: str
    robot: str
    poses: int
    reached: int
    slower: float
    errors: tuple[ToolError, ...]
    contacts: tuple[ContactEvent, ...] = ()
    clearance: float | None = None
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the replay as values for JSON."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Knots:
    """Configurations of the arm at frames of a log.

    Args:
        index: (K,) of the log's frames.
        stamps: (K,) [s].
        q: (K, J) [rad or m].
        T_base_tool: (K, 4, 4) as recorded; without recorded tool poses, by forward kinematics of recorded joints.
        source: of the joints.
        poses: number of poses in the log.
    """

    index: tuple[int, ...]
    stamps: Array
    q: Array
    T_base_tool: Array
    source: str
    poses: int


def find_knots(record: ArmRecord, stamps: Sequence[float], robot: RobotModel) -> Knots | None:
    """Return the joints at frames of a log: recorded ones, or else by IK from tool poses, or None without either.

    Each IK solution is the nearest to that of the previous frame.

    Args:
        record: data of the arm.
        stamps: of the log's frames [s]; NaN for a frame without a stamp.
        robot: the twin's arm.
    """
    index: list[int] = []
    q: list[Array] = []
    tools: list[Array] = []
    recorded = 0
    for i, stamp in enumerate(stamps):
        if not np.isfinite(stamp):
            continue
        joints, tool = record.joints_at(stamp, robot), record.tool_at(stamp)
        if joints is None and tool is None:
            continue
        recorded += 1
        if joints is None and tool is not None:
            found = solve_ik(robot, tool, near=q[-1] if q else None).q
            joints = found[0] if len(found) else None
        if joints is not None:
            index.append(i)
            q.append(joints)
            tools.append(robot.tcp(joints) if tool is None else tool)
    if not recorded:
        return None
    source = RECORDED if record.joints is not None else BY_IK
    at = np.array([stamps[i] for i in index])
    return Knots(tuple(index), at, np.array(q).reshape(-1, len(robot)), np.array(tools), source, recorded)


def replay(knots: Knots, twin: Twin) -> Replay:
    """Follow the knots in the twin and compare the tool poses there.

    Knots at least half a second apart are static poses, and the arm rests at each. Others are samples of a motion. If
    the stamps require more speed than the arm has, the whole replay is slower.
    """
    robot = twin.world.robot
    assert robot is not None
    if len(knots.q) < 2:
        note = f"{len(knots.q)} of {knots.poses} poses are within the arm's reach: a replay needs two"
        return Replay(knots.source, robot.name, knots.poses, len(knots.q), 1.0, (), notes=(note,))
    motion, ends, slower = _motion(knots, robot)
    knot_of_step = {round(end * twin.rate): k for k, end in enumerate(ends) if k > 0}
    tools: dict[int, Array] = {}

    def record_tool(data: Any, now: float) -> None:
        step = round(now * twin.rate)
        if step in knot_of_step and twin.follower is not None:
            tools[knot_of_step[step]] = robot.tcp(np.asarray(data.qpos)[twin.follower.qpos])

    result = twin.follow(motion, watch=record_tool)
    errors = tuple(ToolError(knots.index[k], *pose_gap(knots.T_base_tool[k], tools[k])) for k in sorted(tools))
    notes = list(result.warnings)
    if knots.source == BY_IK:
        notes.append(f"a {robot.name} replaces the arm of the log")
    if slower > 1.0:
        notes.append(f"{slower:.1f} times slower than the log's stamps, because of the arm's speed limits")
    return Replay(
        knots.source,
        robot.name,
        knots.poses,
        len(knots.q),
        slower,
        errors,
        result.contacts,
        result.clearance.value,
        tuple(notes),
    )


def _motion(knots: Knots, robot: RobotModel) -> tuple[JointMotion, Array, float]:
    """Return the motion, the times (K,) [s] of its knots, and the factor by which it is slower than recorded."""
    spans = np.diff(knots.stamps)
    if np.median(spans) < CONSTANTS.static_spacing:
        speed = np.abs(np.gradient(knots.q, knots.stamps, axis=0)) / (CONSTANTS.speed_share * robot.chain.velocity)
        slower = max(1.0, float(speed.max()))
        ends = slower * (knots.stamps - knots.stamps[0])
        return motion_from_samples(ends, knots.q), ends, slower
    least = (MINIMUM_JERK_PEAK * np.abs(np.diff(knots.q, axis=0)) / (CONSTANTS.speed_share * robot.chain.velocity)).max(
        axis=1
    ) + CONSTANTS.dwell
    slower = float(np.maximum(least / spans, 1.0).max())
    ends = slower * (knots.stamps - knots.stamps[0])
    times = np.sort(np.concatenate([ends, ends[1:] - CONSTANTS.dwell]))  # arrive a little early and rest
    at = np.repeat(knots.q, 2, axis=0)[1:]
    t = np.unique(np.concatenate([np.arange(0.0, times[-1], 1 / CONSTANTS.rate), times]))
    q, v, a = (minimum_jerk(t, times, at, order) for order in range(3))
    return JointMotion(t, q, v, a), ends, slower
