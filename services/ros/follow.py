"""FollowJointTrajectory as actionlib's topics: a client sends a goal, reads feedback, may cancel, gets a result."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

import numpy as np

from splatbot.errors import InputError, SplatbotError
from splatbot.logs.ros_frames import header
from splatbot.logs.ros_types import Message, build
from splatbot.planning import WaypointMotion
from splatbot.protocols import Feedback
from splatbot.services.arms import Arm, Arms
from splatbot.services.bus import Message as News
from splatbot.services.jobs import ENDED, Job
from splatbot.services.leases import LeaseError
from splatbot.services.motion_gate import MotionRequest
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.messages import waypoints_of
from splatbot.services.ros.moveit import main_map
from splatbot.services.store import MapStore
from splatbot.services.threads import join_started

_TYPE = "control_msgs/msg/FollowJointTrajectoryAction"
_ACTIVE, _PREEMPTED, _SUCCEEDED, _ABORTED, _REJECTED = 1, 2, 3, 4, 5  # of actionlib_msgs/GoalStatus
_OK, _INVALID_GOAL, _PATH_TOLERANCE = 0, -1, -4  # of control_msgs/FollowJointTrajectory
_STATES = {"succeeded": (_SUCCEEDED, _OK), "cancelled": (_PREEMPTED, _OK), "failed": (_ABORTED, _PATH_TOLERANCE)}
_WAITING = 64

_log = logging.getLogger(__name__)


def action_topic(arm: str, part: str) -> str:
    """Return `/ARM_controller/follow_joint_trajectory/PART`, with part goal, cancel, feedback or result."""
    return f"/{arm}_controller/follow_joint_trajectory/{part}"


def _check_supported(goal: Message) -> None:
    """Check that a goal has no part that would be ignored.

    Raises:
        InputError: it has one; the error names it.
    """
    for name in ("path_tolerance", "goal_tolerance"):
        if len(getattr(goal, name, ())):
            raise InputError("is not supported.", field=name, hint="leave it empty")
    stamp = goal.trajectory.header.stamp
    if stamp.sec + 1e-9 * stamp.nanosec > time.time():
        raise InputError("is in the future.", field="header.stamp", hint="send the goal when it begins; stamp 0 is now")


class FollowJointTrajectory:
    """Executes trajectories that clients send on the service's arms, if they are certified in the main map.

    The arm follows the cubic spline with continuous acceleration through the points of the goal
    (:class:`splatbot.planning.WaypointMotion`). If the first point has a time above 0, the motion begins where the arm
    is. A goal is rejected with the reason if the curve is not certified, begins elsewhere than the arm, or arrives
    during a motion. The owner of the motion is the client's connection: the arm stops when it ends.

    Args:
        graph: where the topics are.
        arms: that execute the goals.
        store: the maps, and the bus that reports motions.
    """

    def __init__(self, graph: RosGraph, arms: Arms, store: MapStore) -> None:
        self._graph, self._arms, self._store = graph, arms, store
        self._lock = threading.Lock()
        self._goals: dict[str, tuple[str, Message]] = {}
        self._leases_lock = threading.Lock()  # its own: a client that leaves must not wait for a certification
        self._leases: dict[tuple[str, int], str] = {}
        graph.on_leave(self._release)
        topics = []
        for arm in arms.names:
            kinds = {"goal": f"{_TYPE}Goal", "cancel": "actionlib_msgs/msg/GoalID"}
            topics += [graph.advertise(action_topic(arm, part), kind) for part, kind in kinds.items()]
            for part in ("feedback", "result"):
                graph.advertise(action_topic(arm, part), f"{_TYPE}{part.capitalize()}")
        self._requests = graph.subscribe(*topics, capacity=_WAITING) if topics else None
        self._news = store.bus.subscribe("motions/*", "jobs/*", capacity=_WAITING, latched=False)
        self._threads = [
            threading.Thread(target=self._take_all, name="ros-goals", daemon=True),
            threading.Thread(target=self._publish_all, name="ros-feedback", daemon=True),
        ]

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End; arms that move go on, they are not ours."""
        if self._requests is not None:
            self._requests.close()
        self._news.close()
        join_started(self._threads, timeout_s)

    def _take_all(self) -> None:
        for news in self._requests or ():
            arm = news.topic.split("/")[1].removesuffix("_controller")
            try:
                if news.topic.endswith("/cancel"):
                    self._cancel(arm, news.value.message.id)
                else:
                    self._begin(arm, news.value.message, news.value.client)
            except Exception:  # one odd goal must not end the others
                _log.exception("%s could not be followed", news.topic)

    def _begin(self, arm: str, goal: Message, client: int) -> None:
        try:
            request = self._request(self._arms.get(arm), goal.goal)
            with self._lock:  # before the first feedback of the motion is published
                job = self._arms.send(arm, request, lease=self._lease(arm, client))
                self._goals[job.id] = arm, goal.goal_id
        except SplatbotError as error:
            self._result(arm, goal.goal_id, _REJECTED, _INVALID_GOAL, str(error))

    def _request(self, arm: Arm, goal: Message) -> MotionRequest:
        _check_supported(goal)
        names, times, given = waypoints_of(goal.trajectory)
        chain = arm.robot.chain
        if sorted(names) != sorted(chain.names):
            hint = f"name {', '.join(chain.names)}"
            raise InputError(f"are {', '.join(names)[:200]}.", field="joint_names", hint=hint)
        q = given[:, [names.index(name) for name in chain.names]]
        if times[0] > 0.0:
            at = arm.robot.home if arm.feedback is None else arm.feedback.position
            times, q = np.concatenate([[0.0], times]), np.concatenate([at[None], q])
        served = main_map(self._store)
        return MotionRequest(WaypointMotion(times, q), arm.robot.name, served.id, served.generation)

    def _lease(self, arm: str, client: int) -> str:
        """Return the lease of a client's connection, taken at its first goal.

        Raises:
            LeaseError: another owner holds it, or the client has left.
        """
        with self._leases_lock:
            if not self._graph.connected(client):
                raise LeaseError("has left.", field="client", hint="stay connected while the arm moves")
            held = self._leases.get((arm, client))
            if held is None or not self._arms.leases.holds(held):
                held = self._leases[arm, client] = self._arms.lease(arm, f"ROS client {client}", seconds=None).id
            return held

    def _release(self, client: int) -> None:
        """End the leases of a client that leaves; its arm stops."""
        with self._leases_lock:
            for arm, owner in [key for key in self._leases if key[1] == client]:
                self._arms.leases.release(self._leases.pop((arm, owner)))

    def _cancel(self, arm: str, goal: str) -> None:
        """Cancel a goal; an empty id cancels all goals of the arm."""
        with self._lock:
            jobs = [job for job, (owner, known) in self._goals.items() if owner == arm and goal in ("", known.id)]
        for job in jobs:
            self._arms.motions.cancel(job)

    def _publish_all(self) -> None:
        for news in self._news:
            try:
                self._publish_state(news)
            except Exception:
                _log.exception("the state of %s could not be published", news.topic)

    def _publish_state(self, news: News) -> None:
        job_id, value = news.topic.split("/", 1)[1], news.value
        with self._lock:
            known = self._goals.get(job_id)
            if known is not None and isinstance(value, Job) and value.state in ENDED:
                del self._goals[job_id]
        if known is None:
            return
        arm, goal = known
        if isinstance(value, Feedback):
            self._feedback(arm, goal, value)
        elif isinstance(value, Job) and value.state in ENDED:
            status, code = _STATES[value.state]
            self._result(arm, goal, status, code, value.detail or "")

    def _feedback(self, arm: str, goal: Message, feedback: Feedback) -> None:
        points = {
            "actual": {"positions": feedback.position, "velocities": feedback.velocity},
            "desired": {"positions": feedback.desired},
            "error": {"positions": feedback.desired - feedback.position},
        }
        names = list(self._arms.get(arm).robot.chain.names)
        self._publish(arm, "feedback", goal, _ACTIVE, "", points | {"joint_names": names})

    def _result(self, arm: str, goal: Message, status: int, code: int, text: str) -> None:
        self._publish(arm, "result", goal, status, text, {"error_code": code, "error_string": text})

    def _publish(self, arm: str, part: str, goal: Message, status: int, text: str, values: dict[str, Any]) -> None:
        goal_status = {"goal_id": goal, "status": status, "text": text}
        message = build(
            f"{_TYPE}{part.capitalize()}", {"header": header(time.time(), ""), "status": goal_status, part: values}
        )
        self._graph.publish(action_topic(arm, part), message)
