"""Goals of FollowJointTrajectory (control_msgs) through rosbridge: the actions of ROS 2, and actionlib of ROS 1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from splatbot.robots.controllers.deviation import GoalPoints
from splatbot.robots.controllers.live import LiveOptions
from splatbot.robots.controllers.rosbridge import Operation

_SUCCEEDED_2 = 4  # action_msgs/GoalStatus
_SUCCEEDED_1 = 3  # actionlib_msgs/GoalStatus
_ERRORS = {  # control_msgs/FollowJointTrajectory
    -1: "INVALID_GOAL",
    -2: "INVALID_JOINTS",
    -3: "OLD_HEADER_TIMESTAMP",
    -4: "PATH_TOLERANCE_VIOLATED",
    -5: "GOAL_TOLERANCE_VIOLATED",
}


@dataclass(frozen=True)
class GoalNews:
    """News of a goal.

    Args:
        goal: its id.
        ended: False for feedback, True for the result.
        problem: why the goal did not succeed; empty for success and feedback.
    """

    goal: str
    ended: bool
    problem: str = ""


class ActionDialect(Protocol):
    """Operations of rosbridge that send and cancel goals of one action.

    The controller has two connections, because a rosbridge_server may read nothing from a connection whose goal runs.
    The goal and its cancellation use the first one, and :meth:`cancel_all` the second one.
    """

    def greeting(self) -> list[Operation]:
        """Return the operations that begin the first connection."""
        ...

    def greeting_to_cancel(self) -> list[Operation]:
        """Return the operations that begin the second connection."""
        ...

    def send(self, goal: str, points: GoalPoints, names: tuple[str, ...], options: LiveOptions) -> Operation:
        """Return the operation that sends a goal."""
        ...

    def cancel(self, goal: str) -> Operation:
        """Return the operation that cancels a goal."""
        ...

    def cancel_all(self) -> Operation:
        """Return the operation that cancels all goals of the action."""
        ...

    def read(self, operation: Operation) -> GoalNews | None:
        """Return the news in an operation of the server, if there are any."""
        ...


class Ros2Action:
    """Actions of ROS 2, as ROSBRIDGE_PROTOCOL 2.1 defines them.

    Args:
        action: name of the action.
    """

    def __init__(self, action: str) -> None:
        self._action = action

    def greeting(self) -> list[Operation]:
        """Return no operation: an action needs none."""
        return []

    def greeting_to_cancel(self) -> list[Operation]:
        """Return no operation: the service that cancels needs none."""
        return []

    def send(self, goal: str, points: GoalPoints, names: tuple[str, ...], options: LiveOptions) -> Operation:
        """Return ``send_action_goal`` with feedback."""
        args = _goal(points, names, options, ("sec", "nanosec"))
        kind = "control_msgs/action/FollowJointTrajectory"
        operation = {"op": "send_action_goal", "id": goal, "action": self._action, "action_type": kind}
        return operation | {"feedback": True, "args": args}

    def cancel(self, goal: str) -> Operation:
        """Return ``cancel_action_goal``."""
        return {"op": "cancel_action_goal", "id": goal, "action": self._action}

    def cancel_all(self) -> Operation:
        """Return a call of the action's service CancelGoal with id and stamp 0, which cancels all goals."""
        info = {"goal_id": {"uuid": [0] * 16}, "stamp": {"sec": 0, "nanosec": 0}}
        service = f"{self._action}/_action/cancel_goal"
        return {
            "op": "call_service",
            "service": service,
            "type": "action_msgs/srv/CancelGoal",
            "args": {"goal_info": info},
        }

    def read(self, operation: Operation) -> GoalNews | None:
        """Return the news in ``action_feedback`` and ``action_result``."""
        if operation.get("action") != self._action:
            return None
        goal = str(operation.get("id"))
        if operation["op"] == "action_feedback":
            return GoalNews(goal, False)
        if operation["op"] != "action_result":
            return None
        values, status = operation.get("values"), operation.get("status")
        good = bool(operation.get("result")) and status == _SUCCEEDED_2
        return GoalNews(goal, True, _problem(values, good, status))


class Ros1Action:
    """Topics of actionlib, as ROS 1 has them.

    Args:
        action: name of the action.
    """

    def __init__(self, action: str) -> None:
        self._action = action

    def greeting(self) -> list[Operation]:
        """Return the subscriptions of feedback and result, and the announcement of goals."""
        topics = [f"{self._action}/{part}" for part in ("feedback", "result")]
        reads = [{"op": "subscribe", "topic": topic} for topic in topics]
        return [*reads, self._advertise("goal", "control_msgs/FollowJointTrajectoryActionGoal"), self._cancels()]

    def greeting_to_cancel(self) -> list[Operation]:
        """Return the announcement of cancellations."""
        return [self._cancels()]

    def send(self, goal: str, points: GoalPoints, names: tuple[str, ...], options: LiveOptions) -> Operation:
        """Return the publication of a goal."""
        args = _goal(points, names, options, ("secs", "nsecs"))
        now = {"secs": 0, "nsecs": 0}
        message = {"header": {"stamp": now, "frame_id": ""}, "goal_id": {"stamp": now, "id": goal}, "goal": args}
        return {"op": "publish", "topic": f"{self._action}/goal", "msg": message}

    def cancel(self, goal: str) -> Operation:
        """Return the publication of the goal's id."""
        message = {"stamp": {"secs": 0, "nsecs": 0}, "id": goal}
        return {"op": "publish", "topic": f"{self._action}/cancel", "msg": message}

    def cancel_all(self) -> Operation:
        """Return the publication of an empty id and stamp, which cancels all goals."""
        return self.cancel("")

    def read(self, operation: Operation) -> GoalNews | None:
        """Return the news in the topics feedback and result."""
        topic = operation.get("topic")
        if operation["op"] != "publish" or topic not in (f"{self._action}/feedback", f"{self._action}/result"):
            return None
        message = operation["msg"]
        goal, status = str(message["status"]["goal_id"]["id"]), message["status"]["status"]
        if topic.endswith("feedback"):
            return GoalNews(goal, False)
        return GoalNews(goal, True, _problem(message["result"], status == _SUCCEEDED_1, status))

    def _cancels(self) -> Operation:
        return self._advertise("cancel", "actionlib_msgs/GoalID")

    def _advertise(self, part: str, kind: str) -> Operation:
        return {"op": "advertise", "topic": f"{self._action}/{part}", "type": kind}


def _goal(points: GoalPoints, names: tuple[str, ...], options: LiveOptions, clock: tuple[str, str]) -> dict[str, Any]:
    """Return a FollowJointTrajectory goal; ``clock`` names seconds and nanoseconds."""

    def duration(nanoseconds: int) -> dict[str, int]:
        return dict(zip(clock, divmod(nanoseconds, 10**9), strict=True))

    rows = (points.position, points.velocity, points.acceleration, points.nanoseconds)
    messages = [
        {"positions": q, "velocities": v, "accelerations": a, "effort": [], "time_from_start": duration(t)}
        for q, v, a, t in zip(*(row.tolist() for row in rows), strict=True)
    ]
    trajectory = {"header": {"stamp": duration(0), "frame_id": ""}, "joint_names": list(names), "points": messages}
    return {
        "trajectory": trajectory,
        "path_tolerance": _tolerances(names, options.path_tolerance),
        "goal_tolerance": _tolerances(names, options.goal_tolerance),
        "goal_time_tolerance": duration(round(1e9 * options.goal_time)),
    }


def _tolerances(names: tuple[str, ...], position: float) -> list[dict[str, Any]]:
    return [{"name": name, "position": position, "velocity": 0.0, "acceleration": 0.0} for name in names]


def _problem(values: object, good: bool, status: object) -> str:
    """Return why a goal did not succeed, from the values of its result; empty if it succeeded."""
    if not isinstance(values, Mapping):
        return "" if good else str(values)[:200]
    code, text = int(values.get("error_code", 0)), str(values.get("error_string", ""))[:200]
    if good and code == 0:
        return ""
    name = _ERRORS.get(code, f"error {code}") if code else f"status {status}"
    return f"{name}, {text}" if text else name
