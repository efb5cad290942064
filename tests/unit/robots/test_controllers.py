"""Controllers without hardware, and following a trajectory with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.collision import RobotSpheres
from splatbot.errors import ControllerError, InputError, LogError
from splatbot.planning import CertifiedMotion, JointTrajectory, certify_motion, time_path
from splatbot.planning.follow import follow
from splatbot.protocols import Controller, Gripper, MotionState
from splatbot.robots.controllers import FakeController, JointRecording, RecordedController
from splatbot.robots.grippers import FakeGripper
from splatbot.robots.panda import panda
from tests.unit.planning.test_timing import path_of


@pytest.fixture(scope="module")
def trajectory() -> JointTrajectory:
    return time_path(path_of(np.stack([panda().home, panda().home + 0.3])), RobotSpheres(panda()), None)


@pytest.fixture(scope="module")
def motion(trajectory: JointTrajectory) -> CertifiedMotion:
    return certify_motion(trajectory, RobotSpheres(panda()), None)


def test_an_arm_without_lag_is_where_the_trajectory_has_it_and_arrives(
    trajectory: JointTrajectory, motion: CertifiedMotion
) -> None:
    controller = FakeController(panda().home)
    assert isinstance(controller, Controller)
    done = follow(controller, motion)
    assert done
    assert done.error.max() < 1e-12
    np.testing.assert_allclose(controller.position, trajectory.end)
    assert done.time[-1] == pytest.approx(trajectory.duration, abs=2e-3)


def test_a_lag_is_reported_as_the_error_that_it_is(trajectory: JointTrajectory, motion: CertifiedMotion) -> None:
    done = follow(FakeController(panda().home, lag=0.01), motion)
    assert done
    states = trajectory.sampled(1000.0)
    assert done.error.max() == pytest.approx(0.01 * np.abs(states.velocity).max(), rel=0.1)  # v · lag
    np.testing.assert_allclose(done.position[-1], trajectory.end, atol=0.011)


def test_too_large_an_error_is_a_fault_that_ends_the_motion_until_it_is_reset(
    trajectory: JointTrajectory, motion: CertifiedMotion
) -> None:
    controller = FakeController(panda().home, lag=0.5)
    done = follow(controller, motion)
    assert done.state is MotionState.FAULT
    assert "from the trajectory" in done.fault
    at = controller.position
    for _ in range(10):
        assert controller.step().state is MotionState.FAULT
    np.testing.assert_array_equal(controller.position, at)
    with pytest.raises(ControllerError, match="at fault"):
        controller.send(motion)
    controller.reset()
    assert controller.step().state is MotionState.IDLE


def test_told_to_stop_the_arm_rests_within_one_period(trajectory: JointTrajectory, motion: CertifiedMotion) -> None:
    controller = FakeController(panda().home)
    half = 0.5 * trajectory.duration
    done = follow(controller, motion, stop=lambda feedback: feedback.time >= half)
    assert done.state is MotionState.STOPPED
    stopped = int(np.argmax(done.time >= half))
    assert len(done.time) == stopped + 2  # the period of the stop command, and the next
    np.testing.assert_array_equal(done.position[-1], done.position[stopped])
    at = controller.position
    feedback = controller.step()
    assert not feedback.velocity.any()
    np.testing.assert_array_equal(feedback.position, at)


def test_a_trajectory_without_a_certificate_of_its_curve_is_not_followed(trajectory: JointTrajectory) -> None:
    controller = FakeController(panda().home)
    with pytest.raises(ControllerError, match="certify_motion"):
        controller.send(trajectory)
    assert controller.step().state is MotionState.IDLE


def test_a_trajectory_from_elsewhere_or_for_another_arm_is_not_followed(motion: CertifiedMotion) -> None:
    with pytest.raises(ControllerError, match="from where the arm is"):
        FakeController(panda().home + 0.1).send(motion)
    with pytest.raises(ControllerError, match="7 joints"):
        FakeController(np.zeros(6)).send(motion)
    controller = FakeController(panda().home)
    controller.send(motion)
    with pytest.raises(ControllerError, match="is moving"):
        controller.send(motion)


def test_a_recording_is_replayed_with_its_errors(
    trajectory: JointTrajectory, motion: CertifiedMotion, tmp_path: Path
) -> None:
    path = tmp_path / "joints.csv"
    path.write_text(trajectory.to_csv(rate=200.0))
    recording = JointRecording.load(path)
    done = follow(RecordedController(recording), motion)
    assert done
    assert done.error.max() < 1e-4  # interpolated between samples 5 ms apart
    late = JointRecording(recording.stamps + np.linspace(0, 0.02, len(recording.stamps)), recording.positions)
    off = follow(RecordedController(late), motion)
    assert 1e-3 < off.error.max() < 0.05
    stuck = JointRecording(recording.stamps, np.repeat(recording.positions[:1], len(recording.stamps), axis=0))
    assert follow(RecordedController(stuck), motion).state is MotionState.FAULT


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "columns"),
        ("time,x\n0,1\n1,2\n", "columns"),
        ("time,position.a\n0,1\n0,2\n", "not after"),
        ("time,position.a\n0,1\n", "no recording"),
        ("time,position.a\n0,one\n1,2\n", "no number"),
        ("time,position.a\n0,nan\n1,2\n", "no recording"),
    ],
)
def test_a_damaged_recording_is_named(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "joints.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=message):
        JointRecording.load(path)


def test_a_gripper_closes_on_what_it_holds() -> None:
    gripper = FakeGripper(width=0.03)
    assert isinstance(gripper, Gripper)
    gripper.move(0.0, force=10.0)
    assert gripper.opening() == 0.03
    assert gripper.holds()
    gripper.move(0.06)
    assert not gripper.holds()
    with pytest.raises(InputError, match="opening"):
        gripper.move(0.2)
    with pytest.raises(InputError, match="force"):
        gripper.move(0.0, force=0.0)
