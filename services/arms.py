"""Arms that follow planned motions, each through the controller protocol."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np

from splatbot.errors import ControllerError, InputError
from splatbot.planning import CertifiedMotion, MotionRefusedError
from splatbot.protocols import Controller, Feedback, MotionState
from splatbot.robots.controllers import FakeController
from splatbot.robots.robot import RobotModel
from splatbot.robots.store import load_robot, robot_names
from splatbot.services.jobs import Job, JobCancelled, JobHandle, Jobs
from splatbot.services.leases import Lease, Leases
from splatbot.services.motion_gate import MotionGate, MotionRequest, MotionWatch
from splatbot.services.store import MapStore
from splatbot.services.topics import JOINTS, JointState, arm_topic, motion_topic, robot_topic

REAL = "real"  # the arm on the network

_FEEDBACK_PERIOD_S = 0.02

_log = logging.getLogger(__name__)


@lru_cache(maxsize=8)
def known_robot(name: str) -> RobotModel:
    """Return a robot by name, built once; unlike :func:`splatbot.robots.store.load_robot` it takes no path.

    Raises:
        InputError: the name is unknown.
    """
    if name not in robot_names():
        raise InputError(f"there is no robot {name[:80]!r}.", field="robot", hint=f"robots: {', '.join(robot_names())}")
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
    """One arm: its robot, the factory of its controller, and the controller once it was needed.

    Args:
        name: in URLs.
        robot: its model.
        make: makes the controller.
        real: others may move the arm, too: by hand, or with its teach pendant.
    """

    name: str
    robot: RobotModel
    make: Callable[[RobotModel], Controller]
    real: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    reading: threading.Lock = field(default_factory=threading.Lock, repr=False)
    controller: Controller | None = None
    feedback: Feedback | None = None

    def ready(self) -> Controller:
        """Return the controller, which the first call creates."""
        if self.controller is None:
            self.controller = self.make(self.robot)
            self.feedback = self.controller.step()
        return self.controller

    def look(self) -> None:
        """Read the position of a real arm at rest."""
        with self.reading:
            if self.real and not self.busy:
                self.feedback = self.ready().step()

    def send(self, motion: CertifiedMotion) -> None:
        """Begin a motion; the caller holds the lock."""
        with self.reading:
            controller = self.ready()
            if self.real:
                controller.reset()  # of an earlier fault; without effect while the arm may still move
            controller.send(motion)

    def stop(self) -> None:
        """Stop a controller that exists, in any state."""
        if self.controller is not None:
            self.controller.stop()

    @property
    def busy(self) -> bool:
        """True while a motion is in progress."""
        return self.lock.locked()


@dataclass(frozen=True)
class EmergencyStop:
    """An emergency stop that is in force.

    Args:
        by: client that sent it.
        since: Unix time [s].
    """

    by: str
    since: float


class Arms:
    """The service's arms; their joints and feedback are published on the bus.

    A motion is sent by the holder of the arm's lease, and through the gate only. It stops if the lease ends, if the map
    changes such that the rest of the motion is not free, and at an emergency stop.

    Args:
        store: the maps, and the bus that receives joints and feedback at 50 Hz while an arm moves.
        makers: factory of each arm's controller.
        robot: name of their model.
    """

    def __init__(
        self,
        store: MapStore,
        makers: Mapping[str, Callable[[RobotModel], Controller]] | None = None,
        *,
        robot: str = "panda",
    ) -> None:
        makers = {"fake": fake_arm, "twin": twin_arm} if makers is None else makers
        self._bus = store.bus
        self._gate = MotionGate(store)
        self._robot = robot
        self._makers = dict(makers)
        self._arms: dict[str, Arm] = {}
        self._lock = threading.Lock()
        self._stop: EmergencyStop | None = None
        self._last_stop: EmergencyStop | None = None
        self.leases = Leases()
        most = len(self._makers) + 1  # one for each arm, and one for a real arm: no motion waits for another arm's
        self.motions = Jobs(self._bus, workers=most, capacity=most)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arms."""
        return tuple(self._makers)

    @property
    def emergency_stop(self) -> EmergencyStop | None:
        """The emergency stop in force, or None."""
        return self._stop

    def connect(self, robot: RobotModel, controller: Controller) -> None:
        """Add the arm ``real``, whose controller is connected; call this before the service begins."""
        arm = Arm(REAL, robot, lambda _: controller, real=True)
        arm.ready()
        with self._lock:
            self._makers[REAL], self._arms[REAL] = arm.make, arm

    def get(self, name: str) -> Arm:
        """Return an arm whose controller is ready; the position of a real arm at rest is read.

        Raises:
            InputError: the name is unknown.
        """
        with self._lock:
            self._check_name(name)
            if name not in self._arms:
                self._arms[name] = Arm(name, known_robot(self._robot), self._makers[name])
            arm = self._arms[name]
            arm.ready()
        arm.look()
        return arm

    def lease(
        self, name: str, owner: str, *, seconds: float | None, preempt: bool = False, admin: bool = False
    ) -> Lease:
        """Take the lease of an arm; see :class:`Leases`.

        Raises:
            InputError: the name is unknown.
            LeaseError: another owner holds it.
        """
        self._check_name(name)
        with self._lock:
            known = self._arms.get(name)
        moving = known is not None and known.busy
        return self.leases.acquire(name, owner, seconds=seconds, preempt=preempt, moving=moving, admin=admin)

    def stop_all(self, by: str) -> EmergencyStop:
        """Stop every arm within one control period and refuse motions until :meth:`reset`. This never waits."""
        stop = self._stop = EmergencyStop(by, time.time())
        self._last_stop = stop
        _log.warning("emergency stop by %s", by)
        for arm in list(self._arms.values()):
            if arm.real:  # at a fault, no motion is followed that would see the stop
                threading.Thread(target=arm.stop, name="emergency stop", daemon=True).start()
        return stop

    def reset(self) -> None:
        """End the emergency stop; motions that it stopped do not go on."""
        self._stop = None

    def send(self, name: str, request: MotionRequest, *, lease: str, key: str | None = None, content: str = "") -> Job:
        """Certify a motion and let an arm execute it.

        The motion is a job: done, faulted or refused by a later map ("failed"), or stopped ("cancelled").

        Args:
            name: of the arm.
            request: the motion.
            lease: valid lease of the arm.
            key, content: see :meth:`splatbot.services.jobs.Jobs.submit`.

        Raises:
            LeaseError: the lease has ended.
            MotionRefusedError: the motion is not certified, or an emergency stop is in force.
            ControllerError: the arm moves, is at fault, or is not where the motion begins.
        """
        known = self.motions.known(key, content)
        if known is not None:
            return known  # a repeated request: the arm must not move twice
        arm = self.get(name)
        self.leases.check(lease, name)
        last_stop = self._last_stop
        self._check_running()
        if not arm.lock.acquire(blocking=False):
            raise ControllerError("is moving.", field=f"arm {name}", hint="stop it, or wait until it has arrived")
        try:
            motion = self._gate.certify(request, arm.robot)
            self._check_running()  # a stop or the end of the lease during the certification
            if self._last_stop is not last_stop:
                raise MotionRefusedError("An emergency stop came meanwhile.", field="stop", hint="plan again")
            self.leases.check(lease, name)
            arm.send(motion)
            work = partial(self._follow, arm, request, motion, lease, last_stop)
            abandoned = partial(self._abandon, arm)
            return self.motions.submit("trajectory", work, key=key, request=content, abandoned=abandoned)[0]
        except BaseException:
            self._abandon(arm)
            raise

    def close(self, timeout_s: float) -> None:
        """Stop every motion."""
        self.motions.close(timeout_s)

    def _abandon(self, arm: Arm) -> None:
        """Let an arm rest whose motion does not begin."""
        controller = arm.ready()
        with arm.reading:
            controller.stop()
            arm.feedback = controller.step()
        arm.lock.release()

    def _check_name(self, name: str) -> None:
        if name not in self._makers:
            raise InputError(f"is {name[:80]!r}.", field="arm", hint=f"arms: {', '.join(self._makers)}")

    def _check_running(self) -> None:
        if (stop := self._stop) is not None:
            hint = "remove the danger, then DELETE /v1/stop"
            raise MotionRefusedError(f"An emergency stop by {stop.by} is in force.", field="stop", hint=hint)

    def _follow(
        self,
        arm: Arm,
        request: MotionRequest,
        motion: CertifiedMotion,
        lease: str,
        last_stop: EmergencyStop | None,
        handle: JobHandle,
    ) -> dict[str, Any]:
        """Follow a motion that was sent after ``last_stop``; a later stop counts although it was reset since."""
        controller = arm.ready()
        published_at, largest = 0.0, 0.0
        begin, steps, reason = time.perf_counter(), 0, ""
        try:
            with MotionWatch(self._gate, request, motion, lambda: steps * controller.period) as watch:
                while True:
                    reason = reason or self._reason_to_stop(watch, lease, last_stop)
                    if reason or handle.cancelled.is_set():
                        controller.stop()
                    feedback = arm.feedback = controller.step()
                    steps += 1
                    largest = max(largest, feedback.error)
                    now = time.perf_counter()
                    ended = feedback.state is not MotionState.MOVING
                    if ended or now - published_at >= _FEEDBACK_PERIOD_S:
                        published_at = now
                        self._publish_feedback(arm, handle, feedback, motion.duration)
                    if ended:
                        break
                    time.sleep(max(0.0, begin + steps * controller.period - time.perf_counter()))
        except BaseException:
            controller.stop()
            raise
        finally:
            arm.lock.release()
        if feedback.state is MotionState.STOPPED and reason:
            raise ControllerError(f"was stopped: {reason}", field=f"arm {arm.name}", hint="plan from where it is")
        if feedback.state is MotionState.STOPPED:
            raise JobCancelled
        if feedback.state is MotionState.FAULT:
            controller.reset()
            raise ControllerError(f"{feedback.fault}.", field=f"arm {arm.name}", hint="plan from where it is")
        return {"seconds": feedback.time, "largest_error": largest, "position": feedback.position.tolist()}

    def _reason_to_stop(self, watch: MotionWatch, lease: str, last_stop: EmergencyStop | None) -> str:
        if (stop := self._last_stop) is not None and stop is not last_stop:
            return f"emergency stop by {stop.by}"
        if not self.leases.holds(lease):
            return "its lease ended; the owner is gone or another owner preempted it"
        return watch.refused

    def _publish_feedback(self, arm: Arm, handle: JobHandle, feedback: Feedback, duration: float) -> None:
        names = arm.robot.chain.names
        joints = JointState(time.time(), names, feedback.position, np.asarray(feedback.velocity))
        self._bus.publish(robot_topic(arm.robot.name, JOINTS), joints)
        self._bus.publish(arm_topic(arm.name, JOINTS), joints)
        self._bus.publish(motion_topic(handle.id), feedback)
        with suppress(JobCancelled):  # the next period stops the arm
            handle.report(feedback.time / duration if duration > 0 else 1.0)
