"""A rosbridge server with a gripper behind GripperCommand or ParallelGripperCommand of control_msgs, for its clients.

It answers as ros2_control's gripper_action_controller, which sends no feedback, or as franka_ros2's franka_gripper,
which never reports a stall.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from websockets.sync.server import ServerConnection

from tests.fake_rosbridge import FakeRosbridge

ACTION = "/gripper_controller/gripper_cmd"
JOINT = "panda_finger_joint1"
_PERIOD_S = 0.008
_SUCCEEDED, _CANCELED, _ABORTED = 4, 5, 6


@dataclass
class HandBehaviour:
    """Faults and dialect of the gripper; times count from the start of a goal [s].

    Args:
        width: of the object between the fingers [m], 0 for no object.
        speed: of each finger [m/s].
        allow_stalling: whether a stall is a success.
        franka: answers of franka_gripper; ``epsilon`` [m] is its default_grasp_epsilon.
        goal_tolerance: [m] of a finger, within which the goal succeeds although the finger moves on.
        feedback: feedback is sent.
        reject: goals are rejected.
        silent: goals get no answer, and have no effect.
        deaf: cancellations have no effect.
        parallel: the action is ParallelGripperCommand, whose goals and results hold a sensor_msgs/JointState.
        abort_at, stall_at, drop_at: the goal is aborted, joint states end, all connections are cut.
        down_s: time without a server after a cut.
    """

    width: float = 0.0
    speed: float = 0.4
    allow_stalling: bool = True
    franka: bool = False
    epsilon: float = 0.005
    goal_tolerance: float = 1e-4
    feedback: bool = False
    reject: bool = False
    silent: bool = False
    deaf: bool = False
    parallel: bool = False
    abort_at: float = np.inf
    stall_at: float = np.inf
    drop_at: float = np.inf
    down_s: float = 0.3


@dataclass
class HandGoal:
    """A goal that runs."""

    name: str
    socket: ServerConnection
    position: float
    started: float


class FakeRosGripper(FakeRosbridge):
    """A gripper whose fingers move at their speed and stop at an object.

    Args:
        behaviour: faults and dialect.

    Attributes:
        finger: position of each finger [m], half of the opening.
        goals: arguments of the goals.
        cancels: number of cancellations that arrived.
        last: name of the last goal, and the connection that sent it.
    """

    def __init__(self, behaviour: HandBehaviour | None = None) -> None:
        self.behaviour = behaviour or HandBehaviour()
        self.finger, self.target = 0.04, 0.04
        self.goals: list[Mapping[str, Any]] = []
        self.cancels, self.stalled = 0, False
        self.last: tuple[str, ServerConnection] | None = None
        self._goal: HandGoal | None = None
        self._moved_at, self._epoch = time.monotonic(), time.time() - time.monotonic()
        super().__init__(_PERIOD_S)

    def repeat_result(self, name: str, status: int) -> None:
        """Send a result of a goal on the connection of the last goal."""
        assert self.last is not None
        values = {"position": 0.0, "effort": 0.0, "stalled": True, "reached_goal": False}
        self._result(self.last[1], name, values, status, result=True)

    def _take(self, socket: ServerConnection, operation: dict[str, Any]) -> None:
        kind = operation["op"]
        if kind == "send_action_goal":
            assert operation["action"] == ACTION
            prefix = "Parallel" if self.behaviour.parallel else ""
            assert operation["action_type"] == f"control_msgs/action/{prefix}GripperCommand"
            self._begin(socket, operation["id"], operation["args"])
        elif kind == "cancel_action_goal":
            self._cancel(operation["id"])
        elif kind == "call_service":
            assert operation["service"] == f"{ACTION}/_action/cancel_goal"
            assert operation["type"] == "action_msgs/srv/CancelGoal"
            self._cancel("")
            answer = {"op": "service_response", "service": operation["service"], "id": operation["id"]}
            self._send(socket, json.dumps(answer | {"values": {"return_code": 0}, "result": True}))

    def _begin(self, socket: ServerConnection, name: str, args: Mapping[str, Any]) -> None:
        with self._lock:
            self.goals.append(args)
            self.last = (name, socket)
            if self.behaviour.silent:
                return
            if self.behaviour.reject:
                self._result(socket, name, "Action goal was rejected", 0, result=False)
                return
            command = args["command"]
            if self.behaviour.parallel:
                assert command["name"] == [JOINT]
                (position,) = command["position"]
                if command["velocity"]:
                    (self.behaviour.speed,) = command["velocity"]
            else:
                position = command["position"]
            self.target = float(position)
            self._goal = HandGoal(name, socket, self.target, time.monotonic())

    def _cancel(self, name: str) -> None:
        with self._lock:
            self.cancels += 1
            if self._goal is not None and name in ("", self._goal.name) and not self.behaviour.deaf:
                self.target = self.finger
                self._end(self._goal, _CANCELED)

    def _tick(self, ticks: int) -> None:
        faults, now = self.behaviour, time.monotonic()
        step, self._moved_at = faults.speed * (now - self._moved_at), now
        moved = self.finger + float(np.clip(self.target - self.finger, -step, step))
        blocked = faults.width > 0.0 and moved <= faults.width / 2 and self.target < faults.width / 2
        self.finger = faults.width / 2 if blocked else moved
        if self._goal is not None:
            self._control(self._goal, blocked, ticks)
        if ticks % 2 == 0 and not self.stalled:
            self._report_state()

    def _control(self, goal: HandGoal, blocked: bool, ticks: int) -> None:
        faults, t = self.behaviour, time.monotonic() - goal.started
        self.stalled = self.stalled or t >= faults.stall_at
        if t >= faults.drop_at:
            faults.drop_at = np.inf
            self._restart(faults.down_s)
        if faults.feedback and ticks % 4 == 0:
            self._feedback(goal)
        if t >= faults.abort_at:
            self._end(goal, _ABORTED)
        elif faults.franka:
            if blocked or self.finger == goal.position:
                reached = 2 * abs(self.finger - goal.position) <= faults.epsilon
                self._end(goal, _SUCCEEDED if reached else _ABORTED, reached=reached)
        elif abs(self.finger - goal.position) <= faults.goal_tolerance:
            self._end(goal, _SUCCEEDED, reached=True)
        elif blocked:
            self._end(goal, _SUCCEEDED if faults.allow_stalling else _ABORTED, stalled=True)

    def _end(self, goal: HandGoal, status: int, *, reached: bool = False, stalled: bool = False) -> None:
        self._goal = None
        values = self._state() | {"stalled": stalled, "reached_goal": reached}
        self._result(goal.socket, goal.name, values, status, result=True)

    def _result(self, socket: ServerConnection, name: str, values: object, status: int, *, result: bool) -> None:
        answer = {"op": "action_result", "action": ACTION, "id": name}
        self._send(socket, json.dumps(answer | {"values": values, "status": status, "result": result}))

    def _feedback(self, goal: HandGoal) -> None:
        values = self._state() | ({} if self.behaviour.parallel else {"stalled": False, "reached_goal": False})
        answer = {"op": "action_feedback", "action": ACTION, "id": goal.name, "values": values}
        self._send(goal.socket, json.dumps(answer))

    def _state(self) -> dict[str, Any]:
        if self.behaviour.parallel:
            return {"state": {"name": [JOINT], "position": [self.finger], "velocity": [], "effort": []}}
        return {"position": self.finger, "effort": 0.0}

    def _report_state(self) -> None:
        now = round(1e9 * (self._moved_at + self._epoch))  # of the position: a busy machine may pause meanwhile
        stamp = dict(zip(("sec", "nanosec"), divmod(now, 10**9), strict=True))
        names, position = ["panda_joint1", JOINT, "panda_finger_joint2"], [9.0, self.finger, self.finger]
        header = {"stamp": stamp, "frame_id": ""}
        message = {"header": header, "name": names, "position": position, "velocity": [], "effort": []}
        self._publish("/joint_states", message)
