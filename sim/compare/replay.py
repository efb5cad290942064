"""A log's arm motion done again by the twin's arm: where its tool comes against where it was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatbot.planning.ik import solve_ik
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.compare.recorded import ArmRecord, pose_gap
from splatbot.sim.contact_monitor import Touch
from splatbot.sim.motion import JointMotion, minimum_jerk, motion_from_samples
from splatbot.sim.twin import Twin

BY_IK = "joints by IK, not recorded"
RECORDED = "recorded joints"
_STILLS = 0.5  # [s] between the frames of a log that rests at each
_RATE = 250.0  # [Hz] at which the motion between rests is sampled
_PEAK = 1.875  # of a minimum jerk's speed, over its mean
_SHARE = 0.9  # of the joints' speed limits
_DWELL = 0.1  # [s] at rest at each pose until the tool is looked at


@dataclass(frozen=True)
class ToolError:
    """The tool at one frame: how far the twin's is from the recorded one [m, rad]."""

    index: int
    position_m: float
    angle_rad: float


@dataclass(frozen=True)
class Replay:
    """What came of doing a motion again.

    Args:
        source: ``BY_IK`` or ``RECORDED``.
        robot: the twin's arm.
        poses: that the log has, and how many of them the arm reaches.
        reached: of them.
        slower: how many times slower than recorded, so that the arm's speed limits hold; 1: as recorded.
        errors: of the tool, by frame, without the first, where the arm begins.
        touches: what the arm touched on its way.
        room: the least room around it [m].
        notes: where not to trust it.
    """

    source: str
    robot: str
    poses: int
    reached: int
    slower: float
    errors: tuple[ToolError, ...]
    touches: tuple[Touch, ...] = ()
    room: float | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Knots:
    """Where the arm was at frames of a log.

    Args:
        index: (K,) of the log's frames.
        stamps: (K,) [s].
        q: (K, J) [rad or m].
        T_base_tool: (K, 4, 4) as recorded; of recorded joints without recorded poses, by forward kinematics.
        source: where the joints come from.
        poses: that the log has.
    """

    index: tuple[int, ...]
    stamps: Array
    q: Array
    T_base_tool: Array
    source: str
    poses: int


def find_knots(record: ArmRecord, stamps: Sequence[float], robot: RobotModel) -> Knots | None:
    """Joints at frames of a log: those recorded, or else by IK from tool poses, each near the one before; None without.

    Args:
        record: of the arm.
        stamps: of the log's frames [s]; NaN where a frame has none.
        robot: the twin's arm.
    """
    index: list[int] = []
    q: list[Array] = []
    tools: list[Array] = []
    told = 0
    for i, stamp in enumerate(stamps):
        if not np.isfinite(stamp):
            continue
        joints, tool = record.joints_at(stamp, robot), record.tool_at(stamp)
        if joints is None and tool is None:
            continue
        told += 1
        if joints is None and tool is not None:
            found = solve_ik(robot, tool, near=q[-1] if q else None).q
            joints = found[0] if len(found) else None
        if joints is not None:
            index.append(i)
            q.append(joints)
            tools.append(robot.tcp(joints) if tool is None else tool)
    if not told:
        return None
    source = RECORDED if record.joints is not None else BY_IK
    at = np.array([stamps[i] for i in index])
    return Knots(tuple(index), at, np.array(q).reshape(-1, len(robot)), np.array(tools), source, told)


def replay(knots: Knots, twin: Twin) -> Replay:
    """Follow the knots and look at the tool there.

    Knots half a second apart or more are single pictures: the arm rests at each. Others sample a motion. Where the
    stamps ask for more speed than the arm has, all of it is slower.
    """
    robot = twin.world.robot
    assert robot is not None
    if len(knots.q) < 2:
        note = f"{len(knots.q)} of {knots.poses} poses are within the arm's reach: nothing to do again"
        return Replay(knots.source, robot.name, knots.poses, len(knots.q), 1.0, (), notes=(note,))
    motion, ends, slower = _motion(knots, robot)
    wanted = {round(end * twin.rate): k for k, end in enumerate(ends) if k > 0}
    tools: dict[int, Array] = {}

    def look(data: Any, now: float) -> None:
        step = round(now * twin.rate)
        if step in wanted and twin.follower is not None:
            tools[wanted[step]] = robot.tcp(np.asarray(data.qpos)[twin.follower.qpos])

    result = twin.follow(motion, watch=look)
    errors = tuple(ToolError(knots.index[k], *pose_gap(knots.T_base_tool[k], tools[k])) for k in sorted(tools))
    notes = list(result.warnings)
    if knots.source == BY_IK:
        notes.append(f"a {robot.name} stands in for the arm of the log")
    if slower > 1.0:
        notes.append(f"{slower:.1f} times slower than the log's stamps, for the arm's speed limits")
    return Replay(
        knots.source,
        robot.name,
        knots.poses,
        len(knots.q),
        slower,
        errors,
        result.touches,
        result.near.room,
        tuple(notes),
    )


def _motion(knots: Knots, robot: RobotModel) -> tuple[JointMotion, Array, float]:
    """The motion, when (K,) [s] it is at each knot, and how many times slower it is than recorded."""
    spans = np.diff(knots.stamps)
    if np.median(spans) < _STILLS:
        speed = np.abs(np.gradient(knots.q, knots.stamps, axis=0)) / (_SHARE * robot.chain.velocity)
        slower = max(1.0, float(speed.max()))
        ends = slower * (knots.stamps - knots.stamps[0])
        return motion_from_samples(ends, knots.q), ends, slower
    least = (_PEAK * np.abs(np.diff(knots.q, axis=0)) / (_SHARE * robot.chain.velocity)).max(axis=1) + _DWELL
    slower = float(np.maximum(least / spans, 1.0).max())
    ends = slower * (knots.stamps - knots.stamps[0])
    times = np.sort(np.concatenate([ends, ends[1:] - _DWELL]))  # it arrives a little before each, and rests
    at = np.repeat(knots.q, 2, axis=0)[1:]
    t = np.unique(np.concatenate([np.arange(0.0, times[-1], 1 / _RATE), times]))
    q, v, a = (minimum_jerk(t, times, at, order) for order in range(3))
    return JointMotion(t, q, v, a), ends, slower
