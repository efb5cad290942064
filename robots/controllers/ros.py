"""An arm behind a joint trajectory controller of ROS: goals and joint states over rosbridge."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from uuid import uuid4

import numpy as np

from splatbot.errors import ControllerError, DeviceError, InputError
from splatbot.planning.certify import CertifiedMotion
from splatbot.protocols import RobotKinematics
from splatbot.robots.controllers.arm_states import ArmStates
from splatbot.robots.controllers.deviation import Deviation, GoalPoints, of_quintics
from splatbot.robots.controllers.goals import ActionDialect, GoalNews, Ros1Action, Ros2Action
from splatbot.robots.controllers.live import LiveController, LiveOptions, Measured
from splatbot.robots.controllers.rosbridge import Operation, RosbridgeLink

_PERIOD_S = 0.01
_ACCEPT_S = 2.0  # [s] in which a goal must be accepted
_SETTLE_S = 2.0  # [s] in which the joint states must show that the arm rests
_MAX_POINTS = 10_000  # of one goal: some 5 MB, where rosbridge_server takes 10 MB
_DIALECTS: dict[int, type[Ros1Action] | type[Ros2Action]] = {1: Ros1Action, 2: Ros2Action}


class RosController(LiveController):
    """A :class:`splatbot.protocols.Controller` that sends each motion as one FollowJointTrajectory goal.

    The points of the goal are the knots of the certified curve with velocities and accelerations. The quintics between
    them are the curve itself (:class:`splatbot.robots.controllers.deviation.GoalPoints`).

    The robot's controller executes the goal without this process: a motion goes on if the connection is lost. It is
    then a fault at once, and the goal is cancelled as soon as the connection is back.

    Args:
        address: of rosbridge, ``ws://host:9090``.
        robot: model of the arm, with the joint names of ``/joint_states``.
        action: name of the FollowJointTrajectory action.
        states: topic of the joint states.
        ros: version of ROS, 1 (actionlib) or 2.
        options: tolerances and times; ``update_rate`` is that of the controller manager.

    Raises:
        InputError: the address or the version is wrong.
        DeviceError: rosbridge does not answer, or no joint states of this robot arrive.
    """

    def __init__(
        self,
        address: str,
        robot: RobotKinematics,
        *,
        action: str = "/joint_trajectory_controller/follow_joint_trajectory",
        states: str = "/joint_states",
        ros: int = 2,
        options: LiveOptions | None = None,
    ) -> None:
        super().__init__(robot, period=_PERIOD_S, options=options or LiveOptions())
        if ros not in _DIALECTS:
            raise InputError(f"is {ros}.", field="ros", hint="give 1 or 2")
        self._dialect: ActionDialect = _DIALECTS[ros](action)
        self._action, self._topic = action, states
        self._states = ArmStates(robot.chain.names)
        self._goal: str | None = None  # that may still run
        self._active = self._cancelling = False
        self._result: GoalNews | None = None
        self._news = threading.Condition()
        self._begun, self._losses = 0.0, 0
        self._goals = RosbridgeLink(address, self._greet_goals, self._take_news)
        try:
            self._reports = RosbridgeLink(address, self._greet, self._take_state)
        except BaseException:
            self._goals.close()
            raise
        if not self._wait(lambda: self._states.latest() is not None, _SETTLE_S):
            self.close()
            hint = f"publish {', '.join(robot.chain.names)} there, with increasing stamps"
            raise DeviceError(f"has no states of a {robot.name}.", field=states, hint=hint)
        self._at = self._measured()

    def close(self) -> None:
        """Cancel a goal that may still run, and end the connections."""
        with suppress(DeviceError):
            self._abort()
        self._goals.close()
        self._reports.close()

    def deviation(self, motion: CertifiedMotion) -> Deviation:
        """Bound the deviation of the set points, and of the quintics between the points of the goal."""
        pieces = motion.motion.pieces()
        if len(pieces) >= _MAX_POINTS:
            text = f"has {len(pieces) + 1} knots, more than {_MAX_POINTS}."
            raise ControllerError(text, field="motion", hint="send it in parts")
        return super().deviation(motion) + of_quintics(pieces, GoalPoints.of(pieces), motion.arm.reach)

    def _begin(self, motion: CertifiedMotion) -> None:
        self._losses = self._total_losses
        goal = uuid4().hex
        with self._news:
            self._goal, self._active, self._cancelling, self._result = goal, False, False, None
        points = GoalPoints.of(motion.motion.pieces())
        self._begun = time.monotonic()
        try:
            self._goals.send(self._dialect.send(goal, points, self.robot.chain.names, self.options))
            with self._news:
                self._news.wait_for(lambda: self._active or self._result is not None, _ACCEPT_S)
            self._check_link()
        except DeviceError as error:
            raise ControllerError(error.message, field=error.field, hint=error.hint) from error
        if not self._active and self._result is None:
            hint = f"check that a controller serves {self._action}"
            raise ControllerError(f"did not begin within {_ACCEPT_S:g} s.", field="goal", hint=hint)
        if self._result is not None and self._result.problem:
            raise ControllerError(f"was rejected: {self._result.problem}.", field="goal", hint="see the robot's log")

    def _advance(self, motion: CertifiedMotion) -> float:
        self._pass_period()
        self._check_link()
        self._check_states()
        if self._result is not None and self._result.problem:
            raise ControllerError(f"ended: {self._result.problem}.", field="goal")
        return time.monotonic() - self._begun

    def _arrived(self, motion: CertifiedMotion) -> bool:
        if self._result is None:
            return False
        distance = np.abs(self._measured().position - motion.reference(motion.duration)[0]).max()
        if not distance <= self.options.goal_tolerance:
            return False
        self._goal = None
        return True

    def _may_move(self) -> bool:
        """Return whether a goal may still run; it is over when the arm is seen at rest.

        While a connection is lost, it may run: the goal is cancelled when the connection is back.
        """

        def rests() -> bool:
            connected = self._goals.connected and self._reports.connected
            return connected and self._states.age <= self.options.max_age and self._states.rests

        if self._goal is not None and self._wait(rests, _SETTLE_S):
            self._goal = None
        return self._goal is not None

    def _abort(self) -> None:
        """Cancel the goal on both connections, and again with each of its feedbacks.

        The second connection works while the first one waits for the goal. Its cancellation may overtake the goal.
        """
        self._cancelling = True
        if (goal := self._goal) is None:
            return
        with suppress(DeviceError):
            self._goals.send(self._dialect.cancel(goal))
        self._reports.send(self._dialect.cancel_all())

    def _await_rest(self) -> None:
        def rests() -> bool:
            self._check_link()
            return self._result is not None and self._states.age <= self.options.max_age and self._states.rests

        if not self._wait(rests, self.options.stop_time):
            raise ControllerError(f"does not rest {self.options.stop_time:g} s after the stop.", field="arm")
        self._goal = None

    def _check_states(self) -> None:
        if self._states.age > self.options.max_age:
            hint = "check the robot's joint state broadcaster, and the stamps, which must increase"
            raise ControllerError(f"are {self._states.age:.2f} s old.", field=self._topic, hint=hint)

    def _measured(self) -> Measured:
        latest = self._states.latest()
        assert latest is not None  # the constructor waited for it, and states are kept
        return Measured(*latest)

    def _resting(self) -> Measured:
        self._check_states()
        if not self._wait(lambda: self._states.rests, _SETTLE_S):
            raise ControllerError("moves.", field="arm", hint="wait until it rests")
        return self._measured()

    @property
    def _total_losses(self) -> int:
        return self._goals.losses + self._reports.losses

    def _check_link(self) -> None:
        """Raise a DeviceError if a connection was lost since the motion began."""
        if self._total_losses != self._losses:
            text = "was lost during the motion; the robot may go on to its end."
            raise DeviceError(text, field="connection", hint="look at the robot; the goal is cancelled on reconnection")

    def _greet_goals(self) -> list[Operation]:
        """Announce goals, and cancel one that ran when the connection was lost."""
        cancels = [] if self._goal is None else [*self._dialect.greeting_to_cancel(), self._dialect.cancel_all()]
        return [*self._dialect.greeting(), *cancels]

    def _greet(self) -> list[Operation]:
        """Subscribe to the states, and cancel a goal that ran when the connection was lost."""
        self._states.restart()
        reads = {"op": "subscribe", "topic": self._topic, "type": "sensor_msgs/JointState", "queue_length": 1}
        cancels = [] if self._goal is None else [self._dialect.cancel_all()]
        return [*self._dialect.greeting_to_cancel(), *cancels, reads]

    def _take_state(self, operation: Operation) -> None:
        if operation.get("op") == "publish" and operation.get("topic") == self._topic:
            self._states.take(operation["msg"])

    def _take_news(self, operation: Operation) -> None:
        news = self._dialect.read(operation)
        with self._news:
            if news is None or news.goal != self._goal:
                return
            if news.ended:
                self._result = news  # the goal counts as running until the arm rests: a bridge may report wrongly
            else:
                self._active = True
            self._news.notify_all()
        if self._cancelling and not news.ended:
            with suppress(DeviceError):
                self._abort()
