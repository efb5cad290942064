"""The client of GripperCommand and ParallelGripperCommand against a gripper that speaks rosbridge on a socket."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from splatbot.errors import GripperError, InputError
from splatbot.protocols import Gripper
from splatbot.robots.grippers.errors import FaultError, LineError, NoAnswerError
from splatbot.robots.grippers.ros import FingerJoint, GripperAction, RosGripper, RosGripperOptions
from tests.fake_ros_gripper import ACTION, FakeRosGripper, HandBehaviour
from tests.waiting import until

PATIENT = RosGripperOptions(max_age=3.0)  # of a machine that is busy


@contextmanager
def connected(options: RosGripperOptions = PATIENT, **behaviour: Any) -> Iterator[tuple[RosGripper, FakeRosGripper]]:
    kind: GripperAction = "ParallelGripperCommand" if behaviour.get("parallel") else "GripperCommand"
    with (
        FakeRosGripper(HandBehaviour(**behaviour)) as hand,
        RosGripper(hand.address, options=options, kind=kind) as gripper,
    ):
        yield gripper, hand


def stands(hand: FakeRosGripper) -> bool:
    at = hand.finger
    time.sleep(0.1)
    return hand.finger == at


@pytest.mark.parametrize("franka", [False, True])
def test_it_moves_and_reports_its_opening(franka: bool) -> None:
    with connected(franka=franka) as (gripper, hand):
        assert isinstance(gripper, Gripper)
        assert gripper.opening() == pytest.approx(0.08)
        assert not gripper.holds()
        for opening in (0.03, 0.0, 0.08):
            gripper.move(opening)
            assert gripper.moving()
            gripper.wait(30.0)
            assert gripper.opening() == pytest.approx(opening, abs=1e-9)
            assert not gripper.moving()
            assert not gripper.holds()
        assert hand.cancels == 0


def test_a_goal_has_the_position_of_a_finger_and_the_force() -> None:
    with connected() as (gripper, hand):
        gripper.move(0.05, force=12.5)
        gripper.wait(30.0)
        gripper.move(0.06)
        gripper.wait(30.0)
        assert hand.goals == [
            {"command": {"position": pytest.approx(0.025), "max_effort": 12.5}},
            {"command": {"position": pytest.approx(0.03), "max_effort": 20.0}},
        ]


def test_a_goal_of_the_parallel_action_is_a_joint_state_with_force_and_speed_of_the_joint() -> None:
    with connected(parallel=True) as (gripper, hand):
        gripper.move(0.03, force=12.5, speed=0.4)
        gripper.wait(30.0)
        gripper.move(0.08)
        gripper.wait(30.0)
        assert gripper.opening() == pytest.approx(0.08)
        commands = [goal["command"] for goal in hand.goals]
        name = ["panda_finger_joint1"]
        assert commands[0] == {"name": name, "position": [pytest.approx(0.015)], "velocity": [pytest.approx(0.2)],
                               "effort": [12.5]}  # fmt: skip
        assert commands[1] == {"name": name, "position": [pytest.approx(0.04)], "velocity": [], "effort": [20.0]}
    knuckle = FingerJoint("knuckle", closed=0.8, opened=0.0, stroke=0.085, lever=0.1)
    assert knuckle.velocity(0.085) == pytest.approx(0.8)
    with connected() as (gripper, hand), pytest.raises(InputError, match="kind: is 'Gripper'"):
        RosGripper(hand.address, kind="Gripper")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="lever"):
        FingerJoint(lever=0.0)


def test_a_stop_and_a_cancelled_goal_of_the_parallel_action_end_as_those_of_the_other() -> None:
    with connected(parallel=True, speed=0.01, feedback=True) as (gripper, hand):
        gripper.move(0.0)
        until(lambda: hand.goals)
        gripper.stop()
        gripper.wait(30.0)
        assert stands(hand)
        assert hand.cancels >= 1


@pytest.mark.parametrize("allow_stalling", [False, True])
@pytest.mark.parametrize("parallel", [False, True])
def test_fingers_that_stall_hold_the_object(allow_stalling: bool, parallel: bool) -> None:
    with connected(width=0.05, allow_stalling=allow_stalling, parallel=parallel) as (gripper, hand):
        gripper.move(0.0)
        gripper.wait(30.0)
        assert gripper.holds()
        assert gripper.opening() == pytest.approx(0.05)
        hand.behaviour.width = 0.0  # it slips out: the fingers go on
        until(lambda: gripper.opening() == 0.0)
        gripper.move(0.08)
        gripper.wait(30.0)
        assert not gripper.holds()


def test_a_panda_holds_an_object_within_its_epsilon_and_aborts_otherwise() -> None:
    with connected(width=0.05, franka=True, epsilon=0.08) as (gripper, hand):
        gripper.move(0.0)
        gripper.wait(30.0)
        assert gripper.holds()  # although the server reports that the goal was reached
        hand.behaviour.epsilon = 0.005
        gripper.move(0.08)
        gripper.wait(30.0)
        gripper.move(0.0)
        with pytest.raises(FaultError, match="default_grasp_epsilon"):
            gripper.wait(30.0)


def test_a_goal_that_succeeds_early_is_not_a_hold() -> None:
    with connected(goal_tolerance=0.01, speed=0.02) as (gripper, _):
        gripper.move(0.0)
        gripper.wait(30.0)
        assert gripper.opening() == 0.0
        assert not gripper.holds()


def test_a_result_that_overtakes_the_states_of_the_motion_does_not_end_it() -> None:
    with connected(RosGripperOptions(max_age=120.0)) as (gripper, hand):
        gripper.wait(60.0)
        hand.stalled = True  # the states are under way
        gripper.move(0.0)
        until(lambda: gripper._result is not None)
        assert gripper.opening() == pytest.approx(0.08)
        assert gripper.moving()
        assert not gripper.holds()
        hand.stalled = False
        gripper.wait(60.0)
        assert gripper.opening() == 0.0


def test_a_stop_from_another_thread_cancels_the_goal() -> None:
    with connected(speed=0.01) as (gripper, hand):
        gripper.move(0.0)
        stopper = threading.Timer(0.3, gripper.stop)
        stopper.start()
        gripper.wait(30.0)
        stopper.join()
        assert hand.cancels >= 1
        assert stands(hand)
        assert 0.0 < gripper.opening() < 0.08
        assert not gripper.holds()
        gripper.move(0.08)  # the cancellations of the first goal do not hit this one
        gripper.wait(30.0)
        assert gripper.opening() == pytest.approx(0.08)


def test_a_new_goal_cancels_the_one_that_runs_and_its_late_result_is_ignored() -> None:
    with connected(speed=0.01) as (gripper, hand):
        gripper.move(0.0)
        first, _ = hand.last or ("", None)
        hand.behaviour.speed = 0.1
        gripper.move(0.08)
        hand.repeat_result(first, 6)
        gripper.wait(30.0)
        assert gripper.opening() == pytest.approx(0.08)
        hand.repeat_result(first, 6)
        time.sleep(0.1)
        assert not gripper.holds()


def test_a_refused_goal_is_an_error_with_its_reason() -> None:
    with connected(reject=True) as (gripper, hand):
        gripper.move(0.0)
        with pytest.raises(GripperError, match="was refused: Action goal was rejected"):
            gripper.wait(30.0)
        hand.behaviour.reject = False
        gripper.move(0.0)
        gripper.wait(30.0)
        assert gripper.opening() == 0.0


def test_an_aborted_goal_is_an_error() -> None:
    with connected(abort_at=0.1, speed=0.01) as (gripper, _):
        gripper.move(0.0)
        with pytest.raises(FaultError, match="aborted without a stall"):
            gripper.wait(30.0)


def test_a_goal_that_another_client_cancels_is_an_error() -> None:
    with connected(speed=0.01) as (gripper, hand):
        gripper.move(0.0)
        until(lambda: hand.goals)
        hand._cancel("")
        with pytest.raises(FaultError, match="another client cancelled"):
            gripper.wait(30.0)


def test_a_goal_without_an_answer_is_an_error_in_time_and_is_cancelled() -> None:
    with connected(RosGripperOptions(goal_time=0.3, max_age=3.0), silent=True) as (gripper, hand):
        gripper.move(0.0)
        with pytest.raises(NoAnswerError, match=r"did not end within 0\.3 s"):
            gripper.wait(30.0)
        until(lambda: hand.cancels >= 2)
        with pytest.raises(NoAnswerError, match="does not end after its cancellation"):
            gripper.move(0.08)


def test_fingers_that_move_too_long_are_stopped() -> None:
    with connected(speed=0.005) as (gripper, hand):
        gripper.move(0.0)
        with pytest.raises(NoAnswerError, match="still moves"):
            gripper.wait(0.2)
        until(lambda: hand.cancels >= 1)
        assert stands(hand)


def test_a_goal_that_ignores_its_cancellation_is_cancelled_with_each_feedback() -> None:
    with connected(speed=0.005, deaf=True, feedback=True) as (gripper, hand):
        gripper.move(0.0)
        until(lambda: hand.goals)
        gripper.stop()
        until(lambda: hand.cancels > 4)
        hand.behaviour.deaf = False
        gripper.wait(30.0)
        assert stands(hand)


def test_a_lost_connection_is_an_error_and_the_goal_is_cancelled_when_it_is_back() -> None:
    with connected(drop_at=0.1, speed=0.01) as (gripper, hand):
        gripper.move(0.0)
        with pytest.raises(LineError, match="was lost during a goal"):
            gripper.wait(30.0)
        until(lambda: hand.cancels >= 1)
        assert stands(hand)
        hand.behaviour.speed = 0.1
        until(lambda: gripper._goals.connected and gripper._reports.connected)
        gripper.move(0.08)
        gripper.wait(30.0)
        assert gripper.opening() == pytest.approx(0.08)


def test_joint_states_that_stall_are_an_error_and_cancel_the_goal() -> None:
    with connected(RosGripperOptions(max_age=0.3), stall_at=0.1, speed=0.01) as (gripper, hand):
        gripper.move(0.0)
        with pytest.raises(LineError, match=r"/joint_states: are \d\.\d+ s old"):
            gripper.wait(30.0)
        until(lambda: hand.cancels >= 1)
        assert stands(hand)


def test_the_end_of_a_client_cancels_its_goal() -> None:
    with connected(speed=0.01) as (gripper, hand):
        gripper.move(0.0)
        until(lambda: hand.goals)
        gripper.close()
        until(lambda: hand.cancels >= 1)
        assert stands(hand)


def test_messages_without_sense_have_no_effect() -> None:
    with connected() as (gripper, hand):
        gripper.move(0.03)
        name = (hand.last or ("", None))[0]
        damaged: Any
        for damaged in ([], 7, {"op": "action_result", "action": ACTION}, {"op": "action_result", "id": name},
                        {"op": "publish", "topic": "/joint_states", "msg": {"name": 7}}):  # fmt: skip
            hand.say(json.dumps(damaged))
        hand.say("{")
        gripper.wait(30.0)
        assert gripper.opening() == pytest.approx(0.03)


def test_values_out_of_range_are_named() -> None:
    with connected() as (gripper, hand):
        for opening, force, speed, name in ((-0.01, None, None, "opening"), (0.09, None, None, "opening"),
                                            (0.01, 0.0, None, "force"), (0.01, None, 0.1, "speed")):  # fmt: skip
            with pytest.raises(InputError, match=name):
                gripper.move(opening, force=force, speed=speed)
        assert not hand.goals
        with pytest.raises(LineError, match="has no states of the joint"):
            RosGripper(hand.address, FingerJoint("thumb"))
        with pytest.raises(InputError, match="force"):
            RosGripper(hand.address, force=math.nan)
    with pytest.raises(LineError, match="cannot be reached"):
        RosGripper("ws://127.0.0.1:9")
    with pytest.raises(InputError, match="no address"):
        RosGripper("robot:9090")
    with pytest.raises(InputError, match="goal_time"):
        RosGripperOptions(goal_time=0.0)
    with pytest.raises(InputError, match="closed, opened"):
        FingerJoint(closed=0.1, opened=0.1)
    with pytest.raises(InputError, match="stroke"):
        FingerJoint(stroke=math.inf)


def test_a_joint_that_closes_with_growing_angle_is_linear() -> None:
    joint = FingerJoint("robotiq_85_left_knuckle_joint", closed=0.8, opened=0.0, stroke=0.085)
    assert [joint.position(opening) for opening in (0.0, 0.0425, 0.085)] == pytest.approx([0.8, 0.4, 0.0])
    assert [joint.opening(position) for position in (0.9, 0.2, -0.1)] == pytest.approx([0.0, 0.06375, 0.085])
