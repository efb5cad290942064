"""The client of ur_rtde against modules of its names with an arm behind them."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import pytest

from splatbot.collision import RobotSpheres
from splatbot.errors import ControllerError, DeviceError, InputError
from splatbot.planning import CertifiedMotion, JointTrajectory, certify_motion, time_path
from splatbot.planning.follow import follow
from splatbot.protocols import Controller, Feedback, MotionState
from splatbot.robots.controllers.live import LiveOptions
from splatbot.robots.controllers.ur import UrController
from splatbot.robots.store import load_robot
from tests.fake_ur import FakeUr, _Control, _Receive
from tests.unit.planning.test_timing import path_of

UR5E = load_robot("ur5e")
ARM = RobotSpheres(UR5E, margin=0.05)  # the robot's smoothing moves the arm off the curve by up to 41 mm


@pytest.fixture(scope="module")
def trajectory() -> JointTrajectory:
    return time_path(path_of(np.stack([UR5E.home, UR5E.home + 0.3])), ARM, None)


@pytest.fixture(scope="module")
def motion(trajectory: JointTrajectory) -> CertifiedMotion:
    return certify_motion(trajectory.slowed(2.0), ARM, None)


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> FakeUr:
    fake = FakeUr(UR5E.home.copy())
    fake.install(monkeypatch)
    return fake


def at(time: float, act: Callable[[], object]) -> Callable[[Feedback], bool]:
    """Return a predicate of :func:`follow` that acts once at a time [s] and stops nothing."""
    done: list[object] = []

    def step(feedback: Feedback) -> bool:
        if feedback.time >= time and not done:
            done.append(act())
        return False

    return step


def test_set_points_are_the_certified_curve_at_the_rate_of_the_arm(arm: FakeUr, motion: CertifiedMotion) -> None:
    controller = UrController("ur", UR5E, lookahead=0.1, gain=300.0)
    assert isinstance(controller, Controller)
    arm.smoothing = 0.02
    done = follow(controller, motion)
    assert done, done.fault
    times = 0.002 * np.arange(1, len(arm.commands) + 1)
    curve = np.array([motion.reference(t)[0] for t in times])
    np.testing.assert_array_equal(arm.commands, curve)
    assert arm.servo_options == {(0.002, 0.1, 300.0)}
    np.testing.assert_allclose(arm.position, motion.reference(motion.duration)[0], atol=0.005)
    assert arm.calls == [("servoStop", 10.0)]


def test_a_stop_names_its_deceleration_and_waits_until_the_arm_rests(arm: FakeUr, motion: CertifiedMotion) -> None:
    controller = UrController("ur", UR5E, deceleration=4.0)
    done = follow(controller, motion, stop=lambda feedback: feedback.time > 0.3)
    assert done.state is MotionState.STOPPED
    assert arm.calls == [("servoStop", 4.0), ("stopJ", 4.0)]
    assert not arm.velocity.any()


def test_an_arm_that_does_not_rest_after_a_stop_is_a_fault(arm: FakeUr, motion: CertifiedMotion) -> None:
    arm.deaf = True
    controller = UrController("ur", UR5E, options=LiveOptions(stop_time=0.1))
    done = follow(controller, motion, stop=lambda feedback: feedback.time > 0.3)
    assert "does not rest" in done.fault


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("safety", 1 << 2 | 1 << 10, "protective stop"),
        ("safety", 1 << 6 | 1 << 7 | 1 << 10, "emergency stop"),
        ("safety", 1 << 4 | 1 << 10, "safeguard stop"),
        ("connected", False, "connection: was lost"),
        ("running", False, "runs no program"),
        ("refuses", True, "servoJ: was refused"),
    ],
)
def test_a_stop_of_the_robot_and_a_lost_connection_are_faults(
    arm: FakeUr, motion: CertifiedMotion, name: str, value: object, message: str
) -> None:
    controller = UrController("ur", UR5E)
    done = follow(controller, motion, stop=at(0.2, lambda: setattr(arm, name, value)))
    assert done.state is MotionState.FAULT
    assert message in done.fault
    assert done.time[-1] < 0.21
    assert ("stopJ", 10.0) in arm.calls
    sent = len(arm.commands)
    controller.reset()
    if name != "refuses":
        arm.velocity[:] = 0.0
        arm.position = UR5E.home.copy()
        with pytest.raises(ControllerError, match=message):
            controller.send(motion)
    assert len(arm.commands) == sent


def test_an_arm_that_leaves_the_tube_around_the_curve_is_stopped(arm: FakeUr, motion: CertifiedMotion) -> None:
    controller = UrController("ur", UR5E, options=LiveOptions(path_tolerance=0.02))
    arm.slips = 0.03
    done = follow(controller, motion)
    assert "from the curve" in done.fault
    assert len(arm.commands) == 1
    assert ("stopJ", 10.0) in arm.calls


def test_a_lag_along_the_curve_is_no_departure_from_it(arm: FakeUr, motion: CertifiedMotion) -> None:
    arm.smoothing = 0.1
    done = follow(UrController("ur", UR5E, options=LiveOptions(path_tolerance=0.01)), motion)
    assert done, done.fault
    assert done.error.max() > 0.05


def test_states_that_no_longer_advance_are_a_fault_and_refuse_a_start(
    arm: FakeUr, trajectory: JointTrajectory, motion: CertifiedMotion
) -> None:
    controller = UrController("ur", UR5E)
    arm.silent = True
    with pytest.raises(ControllerError, match="new states"):
        controller.send(motion)
    arm.silent = False
    impatient = UrController("ur", UR5E, options=LiveOptions(max_age=0.03))
    slow = certify_motion(trajectory.slowed(8.0), ARM, None)
    done = follow(impatient, slow, stop=at(0.1, lambda: setattr(arm, "silent", True)))
    assert "has not reported" in done.fault


def test_joints_that_are_not_finite_are_an_error(arm: FakeUr, motion: CertifiedMotion) -> None:
    controller = UrController("ur", UR5E)
    arm.position[2] = np.nan
    with pytest.raises(ControllerError, match="not finite"):
        controller.send(motion)
    assert not arm.commands


def test_an_arm_that_moves_or_stands_elsewhere_refuses_a_start(
    arm: FakeUr, trajectory: JointTrajectory, motion: CertifiedMotion
) -> None:
    controller = UrController("ur", UR5E)
    arm.velocity[1] = 0.1
    with pytest.raises(ControllerError, match="moves"):
        controller.send(motion)
    arm.velocity[1] = 0.0
    arm.position[1] += 0.02
    with pytest.raises(ControllerError, match="from where the arm is"):
        controller.send(motion)
    with pytest.raises(ControllerError, match="certify_motion"):
        controller.send(trajectory)
    assert not arm.commands


def test_a_slow_rate_needs_a_margin(arm: FakeUr, trajectory: JointTrajectory) -> None:
    controller = UrController("ur", UR5E, frequency=125.0, lookahead=0.03)
    smoothing = UrController("ur", UR5E, lookahead=0.03).deviation(certify_motion(trajectory, ARM, None)).sphere
    for margin, most in ((1e-3, False), (0.05, True)):
        certified = certify_motion(trajectory, RobotSpheres(UR5E, margin=margin), None)
        if most:
            assert follow(controller, certified)
        else:
            with pytest.raises(ControllerError, match="with a margin"):
                controller.send(certified)
    assert 1e-3 < smoothing < controller.deviation(certify_motion(trajectory, ARM, None)).sphere < 0.05
    assert arm.servo_options == {(0.008, 0.03, 300.0)}


def test_connections_end_and_a_wrong_address_or_option_is_named(arm: FakeUr) -> None:
    UrController("ur", UR5E).close()
    assert arm.disconnected == 2
    assert not arm.running
    with pytest.raises(DeviceError, match=r"cannot be reached.*remote control"):
        UrController("192.0.2.1", UR5E)
    with pytest.raises(InputError, match="7 joints"):
        UrController("ur", load_robot("panda"))
    with pytest.raises(InputError, match="lookahead"):
        UrController("ur", UR5E, lookahead=0.5)


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    with pytest.raises(DeviceError, match=r"splatbot\[ur-rtde\]"):
        UrController("ur", UR5E)


@pytest.mark.skipif(find_spec("rtde_control") is None, reason="ur_rtde is not installed")
def test_the_fake_has_methods_of_ur_rtde_alone() -> None:
    import rtde_control  # type: ignore[import-not-found]
    import rtde_receive  # type: ignore[import-not-found]

    for fake, real in ((_Control, rtde_control.RTDEControlInterface), (_Receive, rtde_receive.RTDEReceiveInterface)):
        methods = [name for name, _ in inspect.getmembers(fake, inspect.isfunction) if not name.startswith("_")]
        assert not [name for name in methods if not hasattr(real, name)]
