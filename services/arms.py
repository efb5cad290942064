"""Arms that follow planned motions, each through the controller protocol."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np

from splatbot.errors import ControllerError, InputError
from splatbot.protocols import Controller, Feedback, MotionState, TimedPath
from splatbot.robots.controllers import FakeController
from splatbot.robots.robot import RobotModel
from splatbot.robots.store import load_robot, robot_names
from splatbot.services.bus import Bus
from splatbot.services.jobs import Job, JobCancelled, JobHandle, Jobs
from splatbot.services.topics import JOINTS, JointState, arm_topic, motion_topic, robot_topic

_FEEDBACK_PERIOD_S = 0.02


@lru_cache(maxsize=8)
def known_robot(name: str) -> RobotModel:
    """Return a robot by name, built once; unlike :func:`splatbot.robots.store.load_robot` it takes no path.

    Raises:
        InputError: the name is unknown.
    """
    if name not in robot_names():
        raise InputError(f"is {name[:80]!r}.", field="robot", hint=f"robots: {', '.join(robot_names())}")
    return load_robot(name)


def fake_arm(robot: RobotModel) -> Controller:
    """Return an arm that follows its commands exactly, from its home."""
    return FakeController(robot.home, period=0.005)


def twin_arm(robot: RobotModel) -> Controller:
    """Return the arm of a twin in an empty scene; needs MuJoCo."""
    from splatbot.sim.controller import TwinController
    from splatbot.sim.scene import load_scene
    from splatbot.sim.twin import Twin

    return TwinController(Twin(load_scene("empty"), robot=robot))


@dataclass
class Arm:
    """One arm: its robot, how its controller is made, and the controller once it was needed.

    Args:
        name: in URLs.
        robot: its model.
        make: makes the controller.
    """

    name: str
    robot: RobotModel
    make: Callable[[RobotModel], Controller]
    lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    controller: Controller | None = None
    feedback: Feedback | None = None

    def ready(self) -> Controller:
        """Return the controller, which the first call creates."""
        if self.controller is None:
            self.controller = self.make(self.robot)
            self.feedback = self.controller.step()
        return self.controller

    @property
    def busy(self) -> bool:
        """True while a motion is in progress."""
        return self.lock.locked()


class Arms:
    """The service's arms; their joints and feedback are published on the bus.

    Args:
        bus: receives joints and feedback at 50 Hz while an arm moves.
        makers: factory of each arm's controller.
        robot: name of their model.
    """

    def __init__(
        self,
        bus: Bus,
        makers: Mapping[str, Callable[[RobotModel], Controller]] | None = None,
        *,
        robot: str = "panda",
    ) -> None:
        makers = {"fake": fake_arm, "twin": twin_arm} if makers is None else makers
        self._bus = bus
        self._robot = robot
        self._makers = dict(makers)
        self._arms: dict[str, Arm] = {}
        self._lock = threading.Lock()
        self.motions = Jobs(bus, workers=max(1, len(self._makers)), capacity=len(self._makers))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arms."""
        return tuple(self._makers)

    def get(self, name: str) -> Arm:
        """Return an arm whose controller is ready.

        Raises:
            InputError: the name is unknown.
        """
        with self._lock:
            if name not in self._makers:
                raise InputError(f"is {name[:80]!r}.", field="arm", hint=f"arms: {', '.join(self._makers)}")
            if name not in self._arms:
                self._arms[name] = Arm(name, known_robot(self._robot), self._makers[name])
            arm = self._arms[name]
            arm.ready()
            return arm

    def send(self, name: str, trajectory: TimedPath, *, key: str | None = None, request: str = "") -> Job:
        """Let an arm follow a trajectory; the motion is a job: done, faulted ("failed"), or stopped ("cancelled").

        Raises:
            ControllerError: the arm moves, is at fault, or is not where the trajectory begins.
        """
        known = self.motions.known(key, request)
        if known is not None:
            return known  # a repeated request: the arm must not move twice
        arm = self.get(name)
        if not arm.lock.acquire(blocking=False):
            raise ControllerError("is moving.", field=f"arm {name}", hint="stop it, or wait until it has arrived")
        try:
            arm.ready().send(trajectory)
            work = partial(self._follow, arm, trajectory)
            return self.motions.submit("trajectory", work, key=key, request=request)[0]
        except BaseException:
            arm.lock.release()
            raise

    def close(self, timeout_s: float) -> None:
        """Stop every motion."""
        self.motions.close(timeout_s)

    def _follow(self, arm: Arm, trajectory: TimedPath, handle: JobHandle) -> dict[str, Any]:
        controller = arm.ready()
        published_at, largest = 0.0, 0.0
        begin, steps = time.perf_counter(), 0
        try:
            while True:
                if handle.cancelled.is_set():
                    controller.stop()
                feedback = arm.feedback = controller.step()
                steps += 1
                largest = max(largest, feedback.error)
                now = time.perf_counter()
                ended = feedback.state is not MotionState.MOVING
                if ended or now - published_at >= _FEEDBACK_PERIOD_S:
                    published_at = now
                    self._publish_feedback(arm, handle, feedback, trajectory.duration)
                if ended:
                    break
                time.sleep(max(0.0, begin + steps * controller.period - time.perf_counter()))
        finally:
            arm.lock.release()
        if feedback.state is MotionState.STOPPED:
            raise JobCancelled
        if feedback.state is MotionState.FAULT:
            controller.reset()
            raise ControllerError(f"{feedback.fault}.", field=f"arm {arm.name}", hint="plan from where it is")
        return {"seconds": feedback.time, "largest_error": largest, "position": feedback.position.tolist()}

    def _publish_feedback(self, arm: Arm, handle: JobHandle, feedback: Feedback, duration: float) -> None:
        names = arm.robot.chain.names
        joints = JointState(time.time(), names, feedback.position, np.asarray(feedback.velocity))
        self._bus.publish(robot_topic(arm.robot.name, JOINTS), joints)
        self._bus.publish(arm_topic(arm.name, JOINTS), joints)
        self._bus.publish(motion_topic(handle.id), feedback)
        if not handle.cancelled.is_set():
            handle.report(feedback.time / duration if duration > 0 else 1.0)
