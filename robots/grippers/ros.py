"""A gripper behind GripperCommand or ParallelGripperCommand of ROS 2: goals and joint states over rosbridge."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Self, get_args
from uuid import uuid4

from splatbot.errors import DeviceError, GripperError, InputError
from splatbot.robots.controllers.arm_states import ArmStates
from splatbot.robots.controllers.goals import Ros2Action
from splatbot.robots.controllers.rosbridge import Operation, RosbridgeLink
from splatbot.robots.grippers.checks import check_move
from splatbot.robots.grippers.errors import FaultError, LineError, NoAnswerError

GripperAction = Literal["GripperCommand", "ParallelGripperCommand"]
"""Actions of control_msgs for grippers."""
_SUCCEEDED, _CANCELED, _ABORTED = 4, 5, 6  # action_msgs/GoalStatus
_POLL_S = 0.01
_SETTLE_S = 2.0  # [s] in which joint states must arrive, and a cancelled goal must end


@dataclass(frozen=True)
class RosGripperOptions:
    """Times and tolerances of a gripper behind ROS.

    Args:
        goal_time: [s] time within which a goal must end.
        max_age: [s] largest age of the joint states.
        tolerance: [m] difference of openings within which the commanded one is reached.
    """

    goal_time: float = 10.0
    max_age: float = 0.5
    tolerance: float = 0.002

    def __post_init__(self) -> None:
        for name in ("goal_time", "max_age", "tolerance"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"is {getattr(self, name)}.", field=name, hint="give a number above 0")


@dataclass(frozen=True)
class FingerJoint:
    """Joint whose position the action commands, and its relation to the opening, which is linear.

    The default is a finger of the Panda: its position is half of the opening. A Robotiq 2F-85 has
    ``FingerJoint("robotiq_85_left_knuckle_joint", closed=0.8, opened=0.0, stroke=0.085)``.

    Args:
        name: its name in the joint states.
        closed, opened: position of the joint at the ends of the stroke [m or rad].
        stroke: widest opening [m].
        lever: effort of the joint for each newton of a commanded force, in ParallelGripperCommand [1, or m for a joint
            that turns].

    Raises:
        InputError: a value is out of range.
    """

    name: str = "panda_finger_joint1"
    closed: float = 0.0
    opened: float = 0.04
    stroke: float = 0.08
    lever: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.stroke < math.inf:
            raise InputError(f"is {self.stroke}.", field="stroke", hint="give metres above 0")
        if not 0.0 < self.lever < math.inf:
            hint = "give 1 for a joint that slides, and metres for one that turns"
            raise InputError(f"is {self.lever}.", field="lever", hint=hint)
        if not (math.isfinite(self.closed) and math.isfinite(self.opened)) or self.closed == self.opened:
            raise InputError(f"are {self.closed}, {self.opened}.", field="closed, opened", hint="give two positions")

    def opening(self, position: float) -> float:
        """Convert a position of the joint to the opening [m], within 0 and the stroke."""
        share = (position - self.closed) / (self.opened - self.closed)
        return self.stroke * min(max(share, 0.0), 1.0)

    def position(self, opening: float) -> float:
        """Convert an opening [m] to a position of the joint."""
        return self.closed + opening / self.stroke * (self.opened - self.closed)

    def velocity(self, speed: float) -> float:
        """Convert a speed [m/s] of the opening to that of the joint [1/s of its unit]."""
        return speed / self.stroke * abs(self.opened - self.closed)


@dataclass(frozen=True)
class GripperResult:
    """Result of a goal.

    Args:
        status: of ``action_msgs/GoalStatus``; 0 for a goal that did not begin, or whose connection was lost.
        stalled: whether an object stops the fingers, as the action server reports.
        text: reason of the status 0.
    """

    status: int
    stalled: bool = False
    text: str = ""


class RosGripper:
    """A :class:`splatbot.protocols.Gripper` that sends each move as one goal of GripperCommand or of its successor.

    Openings are those of the joint states, because action servers need not send feedback. A lost connection, a goal
    that is refused, aborted or too late, and old joint states raise :class:`splatbot.errors.GripperError`; the goal is
    cancelled. After a lost connection it is cancelled as soon as the connection is back.

    Args:
        address: of rosbridge, ``ws://host:9090``.
        joint: the finger joint; a finger of the Panda by default.
        action: name of the action; that of the Panda is /franka_gripper/gripper_action.
        states: topic of the joint states.
        force: largest force of a move without one [N]: ``max_effort`` of GripperCommand. In ParallelGripperCommand it
            is the effort of the joint, times its lever.
        options: times and tolerances.
        kind: type of the action.

    Raises:
        InputError: a value is wrong.
        LineError: rosbridge does not answer, or no states of this joint arrive.
    """

    def __init__(
        self,
        address: str,
        joint: FingerJoint | None = None,
        *,
        action: str = "/gripper_controller/gripper_cmd",
        states: str = "/joint_states",
        force: float = 20.0,
        options: RosGripperOptions | None = None,
        kind: GripperAction = "GripperCommand",
    ) -> None:
        if kind not in get_args(GripperAction):
            raise InputError(f"is {kind!r}.", field="kind", hint=f"use {' or '.join(get_args(GripperAction))}")
        if not 0.0 < force < math.inf:
            raise InputError(f"is {force}.", field="force", hint="give newtons above 0")
        self.joint, self.options, self._force = joint or FingerJoint(), options or RosGripperOptions(), force
        self._action, self._topic, self._kind = action, states, kind
        self._dialect = Ros2Action(action)
        self._states = ArmStates((self.joint.name,))
        self._news = threading.Condition()
        self._goal = ""  # the latest goal
        self._running = False  # whether it may still run on the robot
        self._stopped = False  # whether it was cancelled here
        self._result: GripperResult | None = GripperResult(_CANCELED)  # no goal: at rest, with nothing held
        self._target = math.nan  # commanded opening [m]
        self._begun, self._losses = 0.0, 0
        self._ended = -math.inf  # when the result of the latest goal arrived
        self._pending = 0  # calls of the service that cancels
        with _as_line_error(address):
            self._goals = RosbridgeLink(address, list, self._take_news)
            try:
                self._reports = RosbridgeLink(address, self._greet, self._take_report)
            except BaseException:
                self._goals.close()
                raise
        if not self._wait(lambda: self._states.latest() is not None, _SETTLE_S):
            self.close()
            hint = f"publish {self.joint.name} there, with increasing stamps"
            raise LineError("has no states of the joint.", field=states, hint=hint)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Cancel a goal that runs, and end the connections."""
        with suppress(DeviceError):
            self._cancel()
        self._goals.close()
        self._reports.close()

    @property
    def stroke(self) -> float:
        """Widest opening [m]."""
        return self.joint.stroke

    def move(self, opening: float, *, force: float | None = None, speed: float | None = None) -> None:
        """Send a goal with an opening [m], a largest force [N] and speed [m/s]; an earlier goal is cancelled first.

        Raises:
            InputError: a value is out of range, or a speed is given, which GripperCommand does not have.
            GripperError: the connection is lost, or an earlier goal does not end.
        """
        check_move(self.stroke, opening, force, speed)
        if speed is not None and self._kind == "GripperCommand":
            hint = "set the speed in the configuration of the gripper's controller, or use ParallelGripperCommand"
            raise InputError("cannot be commanded by GripperCommand.", field="speed", hint=hint)
        with self._secured():
            self._end_goal()
            goal = uuid4().hex
            with self._news:
                self._goal, self._running, self._stopped, self._result = goal, True, False, None
                self._target, self._begun, self._losses = opening, time.monotonic(), self._total_losses
            command = self._command(opening, self._force if force is None else force, speed)
            kind = f"control_msgs/action/{self._kind}"
            operation = {"op": "send_action_goal", "id": goal, "action": self._action, "action_type": kind}
            self._goals.send(operation | {"feedback": True, "args": {"command": command}})

    def moving(self) -> bool:
        """Return whether a goal runs, or the fingers move."""
        with self._secured():
            self._check()
            return not self._rests()

    def opening(self) -> float:
        """Return the distance between the fingers [m]."""
        with self._secured():
            self._check()
            return self._opening()

    def holds(self) -> bool:
        """Return whether an object stops the fingers; after :meth:`stop` this is unknown, and False.

        The goal has ended, the fingers rest, and the action server reports a stall or they are short of the goal.
        """
        with self._secured():
            self._check()
            if self._result is None or self._stopped or math.isnan(self._target) or not self._rests():
                return False
            return self._result.stalled or abs(self._opening() - self._target) > self.options.tolerance

    def wait(self, seconds: float = 5.0) -> None:
        """Wait until the fingers rest.

        Raises:
            GripperError: they still move after ``seconds`` [s]; the goal is then cancelled.
        """
        with self._secured():

            def rests() -> bool:
                self._check()
                return self._rests()

            if not self._wait(rests, seconds):
                raise NoAnswerError(f"still moves after {seconds:g} s.", field=self._action, hint="look at the gripper")

    def stop(self) -> None:
        """Cancel the goal; the action server decides how the fingers stop.

        Raises:
            LineError: the connection is lost; the goal is then cancelled when it is back.
        """
        with _as_line_error(self._action):
            self._cancel()

    def _command(self, opening: float, force: float, speed: float | None) -> dict[str, Any]:
        """Return the command of a goal: GripperCommand's own message, or a JointState with the limits of the move."""
        joint, position = self.joint, self.joint.position(opening)
        if self._kind == "GripperCommand":
            return {"position": position, "max_effort": force}
        velocity = [] if speed is None else [joint.velocity(speed)]
        return {"name": [joint.name], "position": [position], "velocity": velocity, "effort": [force * joint.lever]}

    def _rests(self) -> bool:
        """Return whether the goal has ended and the fingers rest; its result may overtake the states of the motion."""
        return self._result is not None and self._states.rests_since(self._ended)

    def _opening(self) -> float:
        latest = self._states.latest()
        assert latest is not None  # the constructor waited for it, and states are kept
        return self.joint.opening(float(latest[0][0]))

    def _check(self) -> None:
        """Raise the error of the connection, of the states, or of the latest goal."""
        if self._running and self._total_losses != self._losses:
            hint = "look at the gripper; the goal is cancelled on reconnection"
            raise LineError("was lost during a goal; the gripper may go on.", field="connection", hint=hint)
        if self._states.age > self.options.max_age:
            hint = "check the connection, and the joint state broadcaster"
            raise LineError(f"are {self._states.age:.2f} s old.", field=self._topic, hint=hint)
        result = self._result
        if result is None:
            if time.monotonic() - self._begun > self.options.goal_time:
                hint = f"check that a controller serves {self._action}"
                text = f"did not end within {self.options.goal_time:g} s."
                raise NoAnswerError(text, field="goal", hint=hint)
        elif result.status == _ABORTED and not result.stalled:
            hint = "see the robot's log; for a Panda that closes on an object, widen default_grasp_epsilon"
            raise FaultError(_ABORTED, "the goal was aborted without a stall", field=self._action, hint=hint)
        elif result.status == _CANCELED and not self._stopped and self._goal:
            raise FaultError(_CANCELED, "another client cancelled the goal", field=self._action, hint="send it again")
        elif result.status not in (_SUCCEEDED, _CANCELED, _ABORTED):
            raise GripperError(f"was refused: {result.text}.", field="goal", hint="see the robot's log")

    @contextmanager
    def _secured(self) -> Iterator[None]:
        """Cancel the goal after an error."""
        try:
            with _as_line_error(self._action):
                yield
        except GripperError:
            with suppress(DeviceError):
                self._cancel()
            raise

    def _cancel(self) -> None:
        """Cancel a goal that may run, on both connections.

        A rosbridge_server may read nothing from a connection whose goal runs. The second one therefore calls the
        service that cancels all goals of the action.
        """
        if not self._running:
            return
        self._stopped = True
        with suppress(DeviceError):
            self._goals.send(self._dialect.cancel(self._goal))
        with self._news:
            self._reports.send(self._dialect.cancel_all() | {"id": self._goal})
            self._pending += 1

    def _end_goal(self) -> None:
        """Cancel the latest goal, and wait until no cancellation is under way that could hit the next goal."""
        lost = self._running and self._total_losses != self._losses  # its result went to a connection that is gone
        self._cancel()
        with self._news:
            if not self._news.wait_for(lambda: not self._pending and (lost or not self._running), _SETTLE_S):
                hint = f"check that a controller serves {self._action}, and connect again"
                raise NoAnswerError("does not end after its cancellation.", field="goal", hint=hint)
            self._running = False

    def _greet(self) -> list[Operation]:
        """Subscribe to the states, and cancel a goal that ran when the connection was lost."""
        self._states.restart()
        self._pending = int(self._running)  # responses to the calls before are lost
        reads = {"op": "subscribe", "topic": self._topic, "type": "sensor_msgs/JointState", "queue_length": 1}
        return [reads, self._dialect.cancel_all() | {"id": self._goal}] if self._running else [reads]

    def _take_report(self, operation: Operation) -> None:
        if operation.get("op") == "publish" and operation.get("topic") == self._topic:
            self._states.take(operation["msg"])
        elif operation.get("op") == "service_response":
            with self._news:
                self._pending -= 1
                self._news.notify_all()

    def _take_news(self, operation: Operation) -> None:
        if operation.get("action") != self._action or operation.get("id") != self._goal:
            return  # of an earlier goal
        if operation["op"] == "action_result":
            with self._news:
                self._ended = time.monotonic()  # first: other threads read the result and then this time
                self._result, self._running = _result(operation), False
                self._news.notify_all()
        elif self._stopped:  # feedback of a goal that began after its cancellation
            with suppress(DeviceError):
                self._cancel()

    def _wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        until = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > until:
                return False
            time.sleep(_POLL_S)
        return True

    @property
    def _total_losses(self) -> int:
        return self._goals.losses + self._reports.losses


@contextmanager
def _as_line_error(name: str) -> Iterator[None]:
    """Raise the errors of the connection as those of a gripper."""
    try:
        yield
    except DeviceError as error:
        raise LineError(error.message, file=name, field=error.field, hint=error.hint) from error


def _result(operation: Operation) -> GripperResult:
    """Read ``action_result``; its values are the result of the action, or the text of an error."""
    values, status = operation.get("values"), operation.get("status")
    if not operation.get("result") or not isinstance(values, Mapping) or not isinstance(status, int):
        return GripperResult(0, text=str(values)[:200])
    return GripperResult(status, stalled=values.get("stalled") is True)
