"""The client of FollowJointTrajectory against an arm that speaks rosbridge on a socket."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatbot.collision import RobotSpheres
from splatbot.errors import ControllerError, DeviceError, InputError
from splatbot.grasping.pick import Picker
from splatbot.grasping.pick_types import PickOutcome
from splatbot.planning import CertifiedMotion, JointTrajectory, WaypointMotion, certify_motion, time_path
from splatbot.planning.cubics import CubicPieces
from splatbot.planning.follow import follow
from splatbot.protocols import Array, Controller, Feedback, MotionState
from splatbot.robots.controllers import ros as ros_controller
from splatbot.robots.controllers.arm_states import ArmStates
from splatbot.robots.controllers.deviation import GoalPoints, between_set_points, of_quintics
from splatbot.robots.controllers.live import LiveOptions
from splatbot.robots.controllers.ros import RosController
from splatbot.robots.grippers import FakeGripper
from splatbot.robots.store import load_robot
from tests.fake_ros_arm import Behaviour, FakeRosArm, quintic
from tests.unit.grasping.test_pick import OPTIONS, grasps, sampler, target
from tests.unit.planning.test_timing import path_of
from tests.waiting import until

PANDA = load_robot("panda")
ARM = RobotSpheres(PANDA)
FAST = LiveOptions(update_rate=1000.0)
PATIENT = replace(FAST, max_age=3.0, lag=3.0)  # of a machine that is busy


@pytest.fixture(scope="module")
def trajectory() -> JointTrajectory:
    return time_path(path_of(np.stack([PANDA.home, PANDA.home + 0.3])), ARM, None)


@pytest.fixture(scope="module")
def motion(trajectory: JointTrajectory) -> CertifiedMotion:
    return certify_motion(trajectory.slowed(2.0), ARM, None)


@pytest.fixture(scope="module")
def slow(trajectory: JointTrajectory) -> CertifiedMotion:
    return certify_motion(trajectory.slowed(8.0), ARM, None)


@contextmanager
def connected(
    *, ros: int = 2, options: LiveOptions = PATIENT, at: Array = PANDA.home, **faults: Any
) -> Iterator[tuple[RosController, FakeRosArm]]:
    with FakeRosArm(PANDA.chain.names, at, ros=ros, behaviour=Behaviour(**faults)) as arm:
        controller = RosController(arm.address, PANDA, ros=ros, options=options)
        try:
            yield controller, arm
        finally:
            controller.close()


def stands(arm: FakeRosArm) -> bool:
    at = arm.position.copy()
    time.sleep(0.1)
    return bool(np.array_equal(at, arm.position))


@pytest.mark.parametrize("ros", [1, 2])
def test_the_set_points_of_the_arm_are_on_the_certified_curve_and_it_arrives(motion: CertifiedMotion, ros: int) -> None:
    with connected(ros=ros, lag=0.01) as (controller, arm):
        assert isinstance(controller, Controller)
        done = follow(controller, motion)
        assert done, done.fault
        commands = np.array(arm.commands)
        curve = np.array([motion.reference(t)[0] for t in commands[:, 0]])
        assert len(commands) > 20
        assert np.abs(commands[:, 1:] - curve).max() < 1e-12
        np.testing.assert_allclose(controller.step().position, motion.reference(motion.duration)[0], atol=0.005)
        back = time_path(path_of(np.stack([done.position[-1], PANDA.home])), ARM, None)
        assert follow(controller, certify_motion(back.slowed(2.0), ARM, None))  # a second goal of the same connection


def test_a_spline_through_waypoints_is_executed_as_certified_too() -> None:
    steps = np.array([0.0, 0.02, 0.08, 0.13, 0.15])[:, None] * np.linspace(1.0, -1.0, 7)
    motion = certify_motion(WaypointMotion([0.0, 0.4, 0.9, 1.3, 1.7], PANDA.home + steps), ARM, None)
    with connected() as (controller, arm):
        assert follow(controller, motion)
        commands = np.array(arm.commands)
        curve = np.array([motion.reference(t)[0] for t in commands[:, 0]])
        assert np.abs(commands[:, 1:] - curve).max() < 1e-9


def test_the_goal_names_its_tolerances_and_every_knot(motion: CertifiedMotion) -> None:
    with connected(options=replace(PATIENT, path_tolerance=0.03, goal_tolerance=0.004, goal_time=0.5)) as (
        controller,
        arm,
    ):
        assert follow(controller, motion)
        goal = arm.goals[0]
    assert {t["name"]: t["position"] for t in goal["path_tolerance"]} == dict.fromkeys(PANDA.chain.names, 0.03)
    assert {t["name"]: t["position"] for t in goal["goal_tolerance"]} == dict.fromkeys(PANDA.chain.names, 0.004)
    assert goal["goal_time_tolerance"] == {"sec": 0, "nanosec": 500_000_000}
    points = goal["trajectory"]["points"]
    assert len(points) == len(motion.motion.pieces()) + 1
    assert not np.any([points[i]["velocities"] for i in (0, -1)])  # ros2_control refuses more than 1.2e-7 at the end


def _spheres(q: Array) -> Array:
    return ARM.centers(q)


def _curve(pieces: CubicPieces, times: Array) -> Array:
    """Integrate the jerk of each piece from its start, an evaluation of its own."""
    k = np.clip(np.searchsorted(pieces.time, times, side="right") - 1, 0, len(pieces) - 1)
    x, h = (times - pieces.time[k])[:, None], np.diff(pieces.time)[k][:, None]
    v0 = pieces.velocities()[0][k]
    a0, jerk = pieces.acceleration[k], (pieces.acceleration[k + 1] - pieces.acceleration[k]) / h
    return np.asarray(pieces.position[k] + v0 * x + a0 * x**2 / 2 + jerk * x**3 / 6)


@pytest.mark.parametrize("period", [0.002, 0.01, 0.05])
def test_straight_lines_between_set_points_stay_within_their_bound(trajectory: JointTrajectory, period: float) -> None:
    pieces = trajectory.pieces()
    bound = between_set_points(pieces, ARM.reach, period)
    times = np.linspace(0.0, pieces.duration, 4001)
    at = np.append(np.arange(0.0, pieces.duration, period), pieces.duration)
    points = _curve(pieces, at)
    straight = np.stack([np.interp(times, at, column) for column in points.T], axis=1)
    curve = _curve(pieces, times)
    joint = np.abs(curve - straight).max()
    sphere = np.linalg.norm(_spheres(curve) - _spheres(straight), axis=2).max()
    assert joint - 1e-12 <= bound.joint <= 1.5 * joint + 1e-9
    assert sphere <= bound.sphere


def test_quintics_through_wrong_points_stay_within_their_bound(trajectory: JointTrajectory) -> None:
    pieces = trajectory.pieces()
    exact = GoalPoints.of(pieces)
    assert of_quintics(pieces, exact, ARM.reach).sphere < 1e-9
    rng = np.random.default_rng(3)
    for size in (1e-6, 1e-3, 0.1):
        v = exact.velocity + size * rng.normal(size=exact.velocity.shape)
        wrong = replace(exact, velocity=v, acceleration=exact.acceleration * (1 + size))
        bound = of_quintics(pieces, wrong, ARM.reach)
        times = np.linspace(0.0, pieces.duration, 2001)[:-1]
        points = np.stack([wrong.position, wrong.velocity, wrong.acceleration], axis=1)
        sent = np.array([quintic(np.asarray(1e-9 * wrong.nanoseconds), points, t) for t in times])
        curve = _curve(pieces, times)
        assert np.abs(sent - curve).max() <= bound.joint + 1e-12
        assert np.linalg.norm(_spheres(sent) - _spheres(curve), axis=2).max() <= bound.sphere + 1e-12


def test_a_motion_is_refused_where_its_set_points_leave_the_certified_clearance(trajectory: JointTrajectory) -> None:
    with connected(options=replace(PATIENT, update_rate=100.0)) as (controller, arm):
        tight = certify_motion(trajectory, ARM, None)
        need = controller.deviation(tight).sphere
        assert 3e-4 < need < 5e-4
        with pytest.raises(ControllerError, match=r"margin of 0\.40 mm"):
            controller.send(tight)
        roomy = certify_motion(trajectory, RobotSpheres(PANDA, margin=1e-3), None)
        assert follow(controller, roomy)
        assert len(arm.goals) == 1


def test_nothing_is_sent_that_is_not_certified_for_this_arm_or_begins_elsewhere(
    trajectory: JointTrajectory, motion: CertifiedMotion
) -> None:
    with connected(at=PANDA.home + 0.02) as (controller, arm):
        with pytest.raises(ControllerError, match="certify_motion"):
            controller.send(trajectory)
        with pytest.raises(ControllerError, match="from where the arm is"):
            controller.send(motion)
        ur5e = load_robot("ur5e")
        other = time_path(path_of(np.stack([ur5e.home, ur5e.home + 0.1])), RobotSpheres(ur5e), None)
        with pytest.raises(ControllerError, match="plan for panda"):
            controller.send(certify_motion(other, RobotSpheres(ur5e), None))
        assert not arm.goals
        assert controller.step().state is MotionState.IDLE


def test_limits_of_the_connected_arm_are_checked_again(motion: CertifiedMotion) -> None:
    with connected() as (controller, arm):
        controller._body.robot.chain.velocity[:] *= 0.01
        try:
            with pytest.raises(ControllerError, match="velocity limit"):
                controller.send(motion)
        finally:
            controller._body.robot.chain.velocity[:] /= 0.01
        assert not arm.goals


def test_joint_states_that_stall_refuse_a_start(motion: CertifiedMotion) -> None:
    with connected(options=FAST) as (controller, arm):
        arm.stalled = True
        time.sleep(0.3)
        with pytest.raises(ControllerError, match=r"/joint_states: are \d\.\d+ s old"):
            controller.send(motion)
        assert not arm.goals
        feedback = controller.step()
        assert feedback.state is MotionState.FAULT
        assert "s old" in feedback.fault
        arm.stalled = False
        until(lambda: controller.step().state is MotionState.IDLE)


def test_repeated_joint_states_are_stale_although_they_arrive(motion: CertifiedMotion) -> None:
    with connected(options=FAST) as (controller, arm):
        arm.clock_offset = -3600.0  # a second publisher of an old clock, or a log that is played
        time.sleep(0.3)
        with pytest.raises(ControllerError, match="stamps"):
            controller.send(motion)


def test_an_arm_that_moves_already_refuses_a_start(motion: CertifiedMotion, monkeypatch: pytest.MonkeyPatch) -> None:
    with connected() as (controller, arm):
        monkeypatch.setattr(ros_controller, "_SETTLE_S", 0.5)
        begin = time.monotonic()
        arm.push = lambda now: PANDA.home + 0.02 * (now - begin)  # 2 mrad within the least time of a rest
        until(lambda: np.abs(controller.step().position - PANDA.home).max() > 2e-3)
        with pytest.raises(ControllerError, match="moves"):
            controller.send(motion)


@pytest.mark.parametrize("ros", [1, 2])
def test_a_rejected_goal_is_refused_with_its_reason(motion: CertifiedMotion, ros: int) -> None:
    with connected(ros=ros, reject=True) as (controller, _), pytest.raises(ControllerError, match="was rejected"):
        controller.send(motion)


def test_a_goal_without_an_answer_is_cancelled_and_refused(
    motion: CertifiedMotion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_controller, "_ACCEPT_S", 0.25)
    with connected(silent=True) as (controller, arm):
        with pytest.raises(ControllerError, match=r"did not begin within 0\.25 s"):
            controller.send(motion)
        until(lambda: arm.cancels >= 1)


def test_a_goal_that_begins_after_it_was_given_up_is_cancelled_again(
    slow: CertifiedMotion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_controller, "_ACCEPT_S", 0.25)
    with connected(late_s=0.75, blocks=True) as (controller, arm):
        with pytest.raises(ControllerError, match="did not begin"):
            controller.send(slow)
        before = arm.cancels  # the first one comes before the goal begins
        until(lambda: arm.commands and arm.cancels > before)
        until(lambda: stands(arm))
        assert np.abs(arm.position - PANDA.home).max() < 0.29  # short of the goal


@pytest.mark.parametrize("ros", [1, 2])
def test_an_aborted_goal_is_a_fault_with_its_code(slow: CertifiedMotion, ros: int) -> None:
    with connected(ros=ros, abort_at=0.5) as (controller, _):
        done = follow(controller, slow)
        assert done.state is MotionState.FAULT
        assert "PATH_TOLERANCE_VIOLATED" in done.fault
        with pytest.raises(ControllerError, match="at fault"):
            controller.send(slow)
        controller.reset()
        with pytest.raises(ControllerError, match="from where the arm is"):
            controller.send(slow)


def test_an_arm_that_lags_too_far_violates_its_tolerance(motion: CertifiedMotion) -> None:
    with connected(lag=0.5) as (controller, arm):
        done = follow(controller, motion)
        assert done.state is MotionState.FAULT
        assert "PATH_TOLERANCE" in done.fault or "from the curve" in done.fault
        until(lambda: stands(arm))


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("blocks", [False, True])
def test_a_stop_in_the_middle_waits_until_the_arm_rests(slow: CertifiedMotion, ros: int, blocks: bool) -> None:
    with connected(ros=ros, blocks=blocks) as (controller, arm):
        done = follow(controller, slow, stop=lambda feedback: feedback.time > 0.5)
        assert done.state is MotionState.STOPPED
        assert arm.cancels >= 1
        assert 0.5 < done.time[-2] < 2.0
        assert stands(arm)
        np.testing.assert_allclose(done.position[-1], arm.position)
        assert np.abs(done.position[-1] - PANDA.home).max() < 0.29


def test_an_arm_that_does_not_heed_a_stop_is_a_fault(slow: CertifiedMotion) -> None:
    with connected(deaf=True, options=replace(PATIENT, stop_time=0.5)) as (controller, _):
        done = follow(controller, slow, stop=lambda feedback: feedback.time > 0.3)
        assert done.state is MotionState.FAULT
        assert "does not rest" in done.fault


@pytest.mark.parametrize("ros", [1, 2])
def test_a_lost_connection_is_a_fault_at_once_and_the_goal_is_cancelled_when_it_is_back(
    slow: CertifiedMotion, ros: int
) -> None:
    with connected(ros=ros, drop_at=0.5) as (controller, arm):
        done = follow(controller, slow)
        assert done.state is MotionState.FAULT
        assert "connection" in done.fault
        assert done.time[-1] < 1.5
        until(lambda: arm.cancels >= 1)
        until(lambda: stands(arm))
        assert not np.array_equal(arm.position, done.position[-1])  # its controller went on
        assert np.abs(arm.position - PANDA.home).max() < 0.29
        controller.reset()
        back = time_path(path_of(np.stack([arm.position, PANDA.home])), ARM, None)
        assert follow(controller, certify_motion(back.slowed(3.0), ARM, None))


def test_the_goal_of_a_lost_connection_may_run_although_the_last_states_show_no_motion(
    trajectory: JointTrajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    creeping = certify_motion(trajectory.slowed(100.0), ARM, None)  # less than 1 mrad within 0.3 s of its start
    with connected(options=replace(PATIENT, max_age=120.0)) as (controller, arm):
        controller.send(creeping)
        arm._cut()
        while controller.step().state is MotionState.MOVING:
            pass
        monkeypatch.setattr(ros_controller, "_SETTLE_S", 0.3)
        controller.reset()
        assert controller.state is MotionState.FAULT
        arm._server = arm._serve(arm.port)
        until(lambda: arm.cancels >= 1)


def test_an_interrupted_follow_cancels_the_goal(slow: CertifiedMotion) -> None:
    def interrupt(feedback: Feedback) -> bool:
        if feedback.time > 0.3:
            raise KeyboardInterrupt
        return False

    with connected() as (controller, arm):
        with pytest.raises(KeyboardInterrupt):
            follow(controller, slow, stop=interrupt)
        until(lambda: arm.cancels >= 1)
        until(lambda: stands(arm))
        assert np.abs(arm.position - PANDA.home).max() < 0.29  # short of the goal


def test_a_stop_is_commanded_at_a_fault_too_until_the_arm_rests(slow: CertifiedMotion) -> None:
    with connected(stall_at=0.4, options=FAST) as (controller, arm):
        assert follow(controller, slow).state is MotionState.FAULT
        cancels = arm.cancels
        controller.stop()
        until(lambda: arm.cancels > cancels)


def test_states_that_stall_in_the_middle_are_a_fault_and_cancel_the_goal(slow: CertifiedMotion) -> None:
    with connected(stall_at=0.4, options=FAST) as (controller, arm):
        done = follow(controller, slow)
        assert done.state is MotionState.FAULT
        assert "s old" in done.fault
        assert done.time[-1] < 2.0
        until(lambda: arm.cancels >= 1)
        assert stands(arm)


def test_a_success_that_the_joint_states_deny_is_no_arrival(motion: CertifiedMotion) -> None:
    with connected(lies=True, options=replace(PATIENT, goal_time=0.2)) as (controller, _):
        controller.send(motion)
        assert controller.step().state is MotionState.MOVING
        while (feedback := controller.step()).state is MotionState.MOVING:
            pass
        assert feedback.state is MotionState.DONE
        np.testing.assert_allclose(feedback.position, motion.reference(motion.duration)[0], atol=0.011)


def test_states_of_another_clock_count_after_a_lost_connection_alone() -> None:
    def state(sec: int, q: float) -> dict[str, Any]:
        return {"header": {"stamp": {"sec": sec, "nanosec": 0}}, "name": ["b", "a"], "position": [q, 0.0]}

    def position() -> list[float]:
        latest = states.latest()
        assert latest is not None
        return latest[0].tolist()

    states = ArmStates(("a", "b"))
    assert states.age == np.inf
    assert states.latest() is None
    states.take(state(1000, 1.0))
    states.take(state(5, 2.0))
    assert position() == [0.0, 1.0]
    states.restart()
    states.take(state(5, 2.0))
    assert position() == [0.0, 2.0]
    states.take(state(4, 3.0))
    assert position() == [0.0, 2.0]


def _rest_after(monkeypatch: pytest.MonkeyPatch, states: list[tuple[float, float, float]]) -> list[bool]:
    """Return whether a joint rests after each state, given as time of arrival [s], stamp [s] and position [rad]."""
    now, known, found = [0.0], ArmStates(("a",)), []
    monkeypatch.setattr("splatbot.robots.controllers.arm_states.time", SimpleNamespace(monotonic=lambda: now[0]))
    for now[0], stamp, q in states:
        sec, nanosec = divmod(round(stamp * 1e9), 10**9)
        known.take({"header": {"stamp": {"sec": sec, "nanosec": nanosec}}, "name": ["a"], "position": [q]})
        found.append(known.rests)
    return found


def test_states_that_arrive_late_do_not_show_a_moving_joint_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    speed = 0.02  # [rad/s]; 0.3 mrad from one state to the next
    moving = [(10.0 + 0.016 * k, 5.0 + 0.016 * k, speed * 0.016 * k) for k in range(20)]
    assert not any(_rest_after(monkeypatch, moving))
    late = [(at + (0.2 if k else 0.0), stamp, q) for k, (at, stamp, q) in enumerate(moving)]
    assert not any(_rest_after(monkeypatch, late))
    at_once = [(10.5 + 1e-3 * k, stamp, 0.0) for k, (_, stamp, _) in enumerate(moving)]
    assert not any(_rest_after(monkeypatch, at_once))  # they may all be old


@pytest.mark.parametrize("pace", [1.0, 0.05])
def test_a_joint_rests_once_it_stood_for_the_window_of_a_clock_however_slowly_that_runs(
    pace: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, stop = 0.016, 10  # [s] of the robot's clock between two states, and the first state at the end
    states = [(step / pace * k, 3.0 + step * k, 0.01 * min(k, stop)) for k in range(40)]
    found = _rest_after(monkeypatch, states)
    first = stop + int(0.3 / step)
    assert found == [False] * first + [True] * (40 - first)


@pytest.mark.parametrize("period", [0.12, 0.2, 0.4])
def test_a_joint_that_turns_between_two_sparse_states_moves(period: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """States on both sides of a turning point have one position; a joint that stands has it three times."""
    turn, first = 5.0, 2  # [s] at which it turns, and the state before it
    stamps = [turn + period * (k - first - 0.5) for k in range(6)]
    turning = [(10.0 + stamp, stamp, (stamp - turn) ** 2) for stamp in stamps]
    assert turning[first][2] == pytest.approx(turning[first + 1][2])
    assert _rest_after(monkeypatch, turning) == [False] * 6
    standing = [(at, stamp, 1.0) for at, stamp, _ in turning]
    assert _rest_after(monkeypatch, standing) == [False] * 2 + [True] * 4


def test_a_pick_is_executed_goal_by_goal() -> None:
    with connected(lag=0.005) as (controller, arm):
        picker = Picker(sampler(), controller, FakeGripper(width=0.06), options=OPTIONS)
        result = picker.pick(target("can"), grasps=grasps("can"))
        assert result.outcome is PickOutcome.PICKED, result.reason
        assert len(arm.goals) == 4  # to the pre-grasp, the approach, and two parts of the lift


def test_messages_without_sense_have_no_effect(motion: CertifiedMotion) -> None:
    with connected() as (controller, arm):
        stamp = {"sec": int(time.time()) + 9, "nanosec": 0}
        state = {"header": {"stamp": stamp}, "name": list(PANDA.chain.names), "position": [0.0] * 7, "velocity": []}
        damaged: Any
        for damaged in (
            state | {"position": [0.0] * 3},
            state | {"position": [float("nan")] * 7},
            state | {"position": None},
            state | {"name": 7},
            state | {"header": {}},
            [],
            None,
        ):
            arm.say(json.dumps({"op": "publish", "topic": "/joint_states", "msg": damaged}))
        for text in ("{", "[]", "7", '{"op": "action_result"}', "[" * 10_000, '{"action": 1, "op": []}'):
            arm.say(text)
        time.sleep(0.1)
        np.testing.assert_allclose(controller.step().position, PANDA.home)
        assert follow(controller, motion)


def test_velocities_that_are_not_reported_are_estimated(motion: CertifiedMotion) -> None:
    with connected(positions_only=True) as (controller, _):
        controller.send(motion)
        largest = 0.0
        while (feedback := controller.step()).state is MotionState.MOVING:
            largest = max(largest, float(np.abs(feedback.velocity).max()))
        assert feedback.state is MotionState.DONE
        true = max(np.abs(motion.reference(t)[1]).max() for t in np.linspace(0, motion.duration, 100))
        assert 0.5 * true < largest


def test_addresses_that_lead_nowhere_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceError, match=r"cannot be reached.*rosbridge_server"):
        RosController("ws://127.0.0.1:9", PANDA)
    with pytest.raises(InputError, match="no address"):
        RosController("http://localhost", PANDA)
    with pytest.raises(InputError, match="give 1 or 2"):
        RosController("ws://localhost", PANDA, ros=3)
    monkeypatch.setattr(ros_controller, "_SETTLE_S", 0.25)
    with (
        FakeRosArm(("a", "b"), np.zeros(2)) as arm,
        pytest.raises(DeviceError, match=r"no states of a panda.*panda_joint1"),
    ):
        RosController(arm.address, PANDA)
