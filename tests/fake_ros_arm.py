"""A rosbridge server with an arm behind a joint trajectory controller, for clients of FollowJointTrajectory.

It follows, with a lag, the quintics between the points of a goal, as ros2_control's joint_trajectory_controller does.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from websockets.sync.server import ServerConnection

from splatbot.protocols import Array
from tests.fake_rosbridge import FakeRosbridge

ACTION = "/joint_trajectory_controller/follow_joint_trajectory"
_PERIOD_S = 0.008
_SUCCEEDED, _CANCELED, _ABORTED = {1: 3, 2: 4}, {1: 2, 2: 5}, {1: 4, 2: 6}
_REJECTED_1 = 5


@dataclass
class Behaviour:
    """Faults of the arm; times count from the start of a goal [s].

    Args:
        lag: time constant of the arm [s].
        reject: goals are rejected.
        silent: goals get no answer, and have no effect.
        late_s: time after which a goal begins.
        abort_at, stall_at, drop_at: the goal is aborted, joint states end, all connections are cut.
        down_s: time without a server after a cut.
        blocks: a connection is not read while its goal runs, as by rosbridge without goals in new threads.
        deaf: cancellations have no effect.
        lies: success is reported at the first feedback.
        positions_only: messages have no velocities.
    """

    lag: float = 0.0
    reject: bool = False
    silent: bool = False
    late_s: float = 0.0
    abort_at: float = np.inf
    stall_at: float = np.inf
    drop_at: float = np.inf
    down_s: float = 0.3
    blocks: bool = False
    deaf: bool = False
    lies: bool = False
    positions_only: bool = False


@dataclass
class Goal:
    """A goal that runs."""

    name: str
    socket: ServerConnection
    times: Array
    points: Array  # (N, 3, J) positions, velocities, accelerations
    path_tolerance: Array
    goal_tolerance: Array
    goal_time: float
    started: float
    ended: threading.Event = field(default_factory=threading.Event)


class FakeRosArm(FakeRosbridge):
    """An arm with a rosbridge server on a free port of this machine.

    Args:
        names: of its joints.
        position: (J,) where it stands [rad].
        ros: version whose messages it speaks.
        behaviour: faults.

    Attributes:
        position: (J,) of the arm [rad].
        push: (J,) position [rad] by the monotonic clock [s] while something else moves the arm.
        commands: rows (time since the start of the goal, J positions) of the set points.
        cancels: number of cancellations that arrived.
    """

    def __init__(
        self, names: tuple[str, ...], position: ArrayLike, *, ros: int = 2, behaviour: Behaviour | None = None
    ) -> None:
        self.names, self.ros, self.behaviour = names, ros, behaviour or Behaviour()
        self.position = np.array(position, np.float64)
        self.velocity = np.zeros_like(self.position)
        self.commands: list[Array] = []
        self.goals: list[Mapping[str, Any]] = []
        self.cancels, self.stalled = 0, False
        self.clock_offset = 0.0
        self.push: Callable[[float], Array] | None = None
        self._now, self._epoch = 0.0, time.time() - time.monotonic()  # of a tick, and between the clocks [s]
        self._goal: Goal | None = None
        super().__init__(_PERIOD_S)

    # -- one client --------------------------------------------------------------------------------------------------

    def _take(self, socket: ServerConnection, operation: dict[str, Any]) -> None:
        kind, topic = operation["op"], operation.get("topic", "")
        if self.ros == 2 and kind == "send_action_goal":
            assert operation["action"] == ACTION
            assert operation["action_type"] == "control_msgs/action/FollowJointTrajectory"
            self._begin(socket, operation["id"], operation["args"])
        elif self.ros == 2 and kind == "cancel_action_goal":
            self._cancel(operation["id"])
        elif self.ros == 2 and kind == "call_service" and operation["service"] == f"{ACTION}/_action/cancel_goal":
            assert not any(operation["args"]["goal_info"]["goal_id"]["uuid"])
            self._cancel("")
        elif self.ros == 1 and kind == "publish" and topic == f"{ACTION}/goal":
            self._begin(socket, operation["msg"]["goal_id"]["id"], operation["msg"]["goal"])
        elif self.ros == 1 and kind == "publish" and topic == f"{ACTION}/cancel":
            self._cancel(operation["msg"]["id"])

    def _begin(self, socket: ServerConnection, name: str, args: Mapping[str, Any]) -> None:
        self.goals.append(args)
        if self.behaviour.silent:
            return
        if self.behaviour.reject:
            self._result(socket, name, _REJECTED_1, {"error_code": -1, "error_string": "no"}, rejected=True)
            return
        trajectory = args["trajectory"]
        order = [trajectory["joint_names"].index(each) for each in self.names]
        kinds = ("positions", "velocities", "accelerations")
        points = np.array([[np.array(p[kind])[order] for kind in kinds] for p in trajectory["points"]])
        times = np.array([self._seconds(p["time_from_start"]) for p in trajectory["points"]])
        path, end = (
            np.array([{t["name"]: t["position"] for t in args[part]}[each] for each in self.names])
            for part in ("path_tolerance", "goal_tolerance")
        )
        goal_time = self._seconds(args["goal_time_tolerance"])
        goal = Goal(name, socket, times, points, path, end, goal_time, time.monotonic())
        time.sleep(self.behaviour.late_s)
        goal.started = time.monotonic()
        with self._lock:
            self.commands.clear()
            self._goal = goal
        if self.behaviour.blocks:
            goal.ended.wait()

    def _cancel(self, name: str) -> None:
        with self._lock:
            self.cancels += 1
            if self._goal is not None and name in ("", self._goal.name) and not self.behaviour.deaf:
                self._end(self._goal, _CANCELED[self.ros], 0)

    def _seconds(self, duration: Mapping[str, int]) -> float:
        first, second = ("sec", "nanosec") if self.ros == 2 else ("secs", "nsecs")
        return duration[first] + 1e-9 * duration[second]

    # -- the arm -----------------------------------------------------------------------------------------------------

    def _tick(self, ticks: int) -> None:
        self._now = time.monotonic()  # of the position and its stamp: a busy machine may pause between them
        if self.push is not None:
            self.position = self.push(self._now)
        if self._goal is not None:
            self._control(self._goal, self._now - self._goal.started, ticks)
        if ticks % 2 == 0 and not self.stalled:
            self._report_states()

    def _control(self, goal: Goal, t: float, ticks: int) -> None:
        faults = self.behaviour
        desired = quintic(goal.times, goal.points, t)
        period = t - self.commands[-1][0] if self.commands else _PERIOD_S
        self.commands.append(np.array([t, *desired]))
        before = self.position
        share = 1.0 - np.exp(-period / faults.lag) if faults.lag else 1.0
        self.position = before + share * (desired - before)
        self.velocity = (self.position - before) / period
        error = np.abs(desired - self.position)
        if ticks % 4 == 0:
            self._feedback(goal)
        self.stalled = self.stalled or t >= faults.stall_at
        if t >= faults.drop_at:
            faults.drop_at = np.inf
            self._restart(faults.down_s)
        if faults.lies:
            self._send_result(goal, _SUCCEEDED[self.ros], 0)
            faults.lies = False
        if t >= faults.abort_at:
            self._end(goal, _ABORTED[self.ros], -4)
        elif t < goal.times[-1]:
            if (error > goal.path_tolerance).any():
                self._end(goal, _ABORTED[self.ros], -4)
        elif (error <= goal.goal_tolerance).all():
            self._end(goal, _SUCCEEDED[self.ros], 0)
        elif t > goal.times[-1] + goal.goal_time:
            self._end(goal, _ABORTED[self.ros], -5)

    def _end(self, goal: Goal, status: int, code: int) -> None:
        self.velocity = np.zeros_like(self.position)
        self._goal = None
        goal.ended.set()
        self._send_result(goal, status, code)

    def _send_result(self, goal: Goal, status: int, code: int) -> None:
        self._result(goal.socket, goal.name, status, {"error_code": code, "error_string": ""})

    # -- messages ----------------------------------------------------------------------------------------------------

    def _result(
        self, socket: ServerConnection, name: str, status: int, values: dict[str, Any], *, rejected: bool = False
    ) -> None:
        if self.ros == 1:
            message = {"status": {"goal_id": {"id": name}, "status": status, "text": ""}, "result": values}
            self._publish(f"{ACTION}/result", message)
            return
        answer: dict[str, Any] = {"op": "action_result", "action": ACTION, "id": name}
        if rejected:
            answer |= {"values": "Action goal was rejected", "status": 0, "result": False}
        else:
            answer |= {"values": values, "status": status, "result": True}
        self._send(socket, json.dumps(answer))

    def _feedback(self, goal: Goal) -> None:
        values = {"joint_names": list(self.names), "actual": {"positions": self.position.tolist()}}
        if self.ros == 1:
            message = {"status": {"goal_id": {"id": goal.name}, "status": 1}, "feedback": values}
            self._publish(f"{ACTION}/feedback", message)
        else:
            answer = {"op": "action_feedback", "action": ACTION, "id": goal.name, "values": values}
            self._send(goal.socket, json.dumps(answer))

    def _report_states(self) -> None:
        """Publish the states of another device, then the arm's in reversed order with one more joint."""
        self._publish("/joint_states", self._states(("lift",), np.zeros(1), np.zeros(1)))
        names = (*self.names[::-1], "finger")
        self._publish(
            "/joint_states", self._states(names, np.r_[self.position[::-1], 9.0], np.r_[self.velocity[::-1], 0])
        )

    def _states(self, names: tuple[str, ...], position: Array, velocity: Array) -> dict[str, Any]:
        now = self._now + self._epoch + self.clock_offset
        clock = ("sec", "nanosec") if self.ros == 2 else ("secs", "nsecs")
        stamp = dict(zip(clock, divmod(int(now * 1e9), 10**9), strict=True))
        given = [] if self.behaviour.positions_only else velocity.tolist()
        header = {"stamp": stamp, "frame_id": ""}
        return {"header": header, "name": list(names), "position": position.tolist(), "velocity": given, "effort": []}


def quintic(times: Array, points: Array, t: float) -> Array:
    """Return the position (J,) at a time of quintics through positions, velocities and accelerations (N, 3, J)."""
    if t >= times[-1]:
        return np.asarray(points[-1, 0])
    k = int(np.searchsorted(times, t, side="right")) - 1
    T, x = times[k + 1] - times[k], t - times[k]
    ends = np.array(
        [
            [1, 0, 0, 0, 0, 0],
            [0, 1, 0, 0, 0, 0],
            [0, 0, 2, 0, 0, 0],
            [1, 1, 1, 1, 1, 1],
            [0, 1, 2, 3, 4, 5],
            [0, 0, 2, 6, 12, 20],
        ],
        np.float64,
    )
    scale = np.array([1.0, T, T * T])[:, None]
    coefficients = np.linalg.solve(ends, np.concatenate([scale * points[k], scale * points[k + 1]]))
    return np.asarray((x / T) ** np.arange(6) @ coefficients)
