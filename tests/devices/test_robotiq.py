"""The Robotiq driver on a serial port behind which a gripper speaks the same bytes, on good lines and on bad ones."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from splatbot.errors import GripperError, InputError
from splatbot.protocols import Gripper
from splatbot.robots.grippers import FakeRobotiq, LineFaults, RobotiqGripper
from splatbot.robots.grippers.errors import FaultError, LineError, NoAnswerError, RefusedError
from splatbot.robots.grippers.registers import Fingers
from tests.devices.lines import emulate_timeouts, wait_for_rest

HURRY = 20.0


@pytest.fixture
def device() -> Iterator[FakeRobotiq]:
    with FakeRobotiq(hurry=HURRY) as one:
        yield one


@pytest.fixture
def gripper(device: FakeRobotiq) -> Iterator[RobotiqGripper]:
    """A driver that waits long for answers, which a busy machine gives late."""
    with RobotiqGripper(device.port, timeout=5.0) as one:
        one.activate()
        yield one


@pytest.fixture
def hasty(device: FakeRobotiq, monkeypatch: pytest.MonkeyPatch) -> Iterator[RobotiqGripper]:
    """A driver that waits briefly, for lines without good answers."""
    emulate_timeouts(monkeypatch, device)
    with RobotiqGripper(device.port, timeout=0.03) as one:
        one.activate()
        yield one


def test_it_activates_moves_and_tells_where_it_is(device: FakeRobotiq) -> None:
    with RobotiqGripper(device.port, timeout=5.0) as gripper:
        assert isinstance(gripper, Gripper)
        gripper.activate()
        for opening in (0.03, 0.0, 0.085, 0.0501):
            gripper.move(opening)
            gripper.wait()
            assert gripper.opening() == pytest.approx(opening, abs=3e-4)  # half a count is 0.2 mm
            assert not gripper.holds()
        assert gripper.repeated == 0


def test_force_and_speed_reach_the_registers_within_their_range(gripper: RobotiqGripper, device: FakeRobotiq) -> None:
    seen = []
    for force, speed in ((20.0, 0.02), (235.0, 0.15), (127.5, 0.085), (1e3, 1e3), (1e-3, 1e-3), (None, None)):
        gripper.move(0.04, force=force, speed=speed)
        gripper.status()
        seen.append((device.commanded.force, device.commanded.speed))
    assert seen == [(0, 0), (255, 255), (128, 128), (255, 255), (0, 0), (64, 255)]


def test_fingers_stop_at_an_object_and_say_that_they_hold_it(gripper: RobotiqGripper, device: FakeRobotiq) -> None:
    device.width = 0.05
    gripper.move(0.0, force=40.0)
    gripper.wait()
    assert gripper.holds()
    assert gripper.opening() == pytest.approx(0.05, abs=3e-4)
    device.width = 0.0  # it slips out: the fingers go on
    gripper.wait()
    assert not gripper.holds()
    assert gripper.opening() == 0.0


def test_a_stop_from_another_thread_ends_a_slow_move_at_once(gripper: RobotiqGripper, device: FakeRobotiq) -> None:
    device.hurry = 1.0
    gripper.move(0.0, speed=0.02)
    stopper = threading.Timer(0.1, gripper.stop)
    stopper.start()
    gripper.wait(30.0)
    stopper.join()
    at = gripper.opening()
    assert 0.05 < at < 0.085
    assert not gripper.moving()
    time.sleep(0.05)
    assert gripper.opening() == at


def test_no_move_before_it_is_activated_and_no_second_activation_drops_what_it_holds(device: FakeRobotiq) -> None:
    device.width = 0.05
    with RobotiqGripper(device.port, timeout=5.0) as first:
        with pytest.raises(GripperError, match="not activated"):
            first.move(0.01)
        first.activate()
        first.move(0.0)
        first.wait()
    with RobotiqGripper(device.port, timeout=5.0) as second:
        asked = len(device.requests)
        second.activate()
        assert len(device.requests) == asked + 1  # one question, no command
        assert second.holds()


def test_values_out_of_range_are_named(gripper: RobotiqGripper, device: FakeRobotiq) -> None:
    asked = len(device.requests)
    for opening, force, speed, name in ((-0.01, None, None, "opening"), (0.09, None, None, "opening"),
                                        (np.nan, None, None, "opening"), (0.01, 0.0, None, "force"),
                                        (0.01, None, -1.0, "speed")):  # fmt: skip
        with pytest.raises(InputError, match=name):
            gripper.move(opening, force=force, speed=speed)
    assert len(device.requests) == asked
    with pytest.raises(InputError, match="2f-85, 2f-140"):
        RobotiqGripper(device.port, "3f")


def test_a_fault_is_an_error_that_names_it_and_ends_with_an_activation(
    gripper: RobotiqGripper, device: FakeRobotiq
) -> None:
    gripper.move(0.0)
    device.fault = 0x0E
    with pytest.raises(FaultError, match="current was too high") as caught:
        gripper.wait()
    assert caught.value.fault == 0x0E
    assert not device.commanded.go
    with pytest.raises(GripperError, match="takes no move"):
        gripper.move(0.02)
    gripper.activate()
    gripper.move(0.02)
    gripper.wait()


def test_after_a_release_it_must_be_activated(gripper: RobotiqGripper) -> None:
    gripper.release()
    with pytest.raises(GripperError, match="automatic release"):
        gripper.move(0.02)
    with pytest.raises(FaultError, match="automatic release"):
        gripper.status()
    gripper.activate()
    gripper.move(0.02)


def test_calibration_takes_the_grippers_own_ends(gripper: RobotiqGripper, device: FakeRobotiq) -> None:
    device.model = replace(device.model, open_at=3, closed_at=227)
    model = gripper.calibrate()
    assert (model.open_at, model.closed_at) == (3, 227)
    device.width = 0.07
    with pytest.raises(GripperError, match="closes at"):
        gripper.calibrate()


def test_a_thousand_commands_on_a_line_that_loses_bytes_end_done_or_as_an_error_and_at_rest(
    device: FakeRobotiq, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    emulate_timeouts(monkeypatch, device)
    rng = np.random.default_rng(5)
    with RobotiqGripper(device.port, timeout=0.008, retries=2) as gripper:
        gripper.activate()
        device.faults = LineFaults(drop=0.006, flip=0.002, half=0.02)
        done = failed = 0
        with caplog.at_level(logging.INFO, logger="splatbot"):
            for k in range(1000):
                opening = float(rng.uniform(0.0, gripper.stroke))
                try:
                    gripper.move(opening)
                    status = gripper.status()
                    # The status refers to this command, not to an earlier one.
                    assert status.requested == gripper.model.position(opening)
                    assert status.going
                    done += 1
                except GripperError:
                    assert gripper.unsafe
                    failed += 1
                    for _ in range(20):
                        try:
                            gripper.activate()
                            break
                        except GripperError:
                            pass
                    assert not gripper.unsafe, k
    assert done + failed == 1000
    assert done >= 900
    assert "try 1 of 3" in caplog.text  # repeated tries are logged


@pytest.mark.parametrize(
    ("faults", "error"),
    [
        (LineFaults(silent=True), NoAnswerError),
        (LineFaults(drop=1.0), NoAnswerError),
        (LineFaults(half=1.0), NoAnswerError),
        (LineFaults(flip=1.0), NoAnswerError),
        (LineFaults(delay=0.2), NoAnswerError),
    ],
    ids=["silent", "drops", "halves", "flips", "late"],
)
def test_a_line_that_never_gives_a_good_answer_is_a_typed_error_after_bounded_tries(
    hasty: RobotiqGripper, device: FakeRobotiq, faults: LineFaults, error: type[GripperError]
) -> None:
    device.faults = faults
    with pytest.raises(error, match="no good answer to 5 tries"):
        hasty.move(0.01)
    assert hasty.unsafe
    device.faults = LineFaults()
    wait_for_rest(device)
    with pytest.raises(GripperError, match="takes no move"):
        hasty.move(0.02)
    hasty.activate()
    hasty.move(0.02)
    hasty.wait()
    assert hasty.opening() == pytest.approx(0.02, abs=3e-4)


def test_an_unplugged_gripper_is_a_typed_error_and_its_port_is_given_back(
    gripper: RobotiqGripper, device: FakeRobotiq
) -> None:
    gripper.move(0.01)
    device.unplug()
    with pytest.raises(LineError, match="is gone"):
        gripper.wait()
    for call in (gripper.opening, gripper.holds, gripper.stop, gripper.moving):
        with pytest.raises(LineError, match="not open"):
            call()
    with pytest.raises(GripperError, match="takes no move"):
        gripper.move(0.02)
    with pytest.raises(LineError, match="cannot be opened"):
        gripper.activate()
    gripper.close()


def test_a_port_that_is_not_there_or_taken_is_named(device: FakeRobotiq) -> None:
    with pytest.raises(LineError, match="no-such-port: cannot be opened"):
        RobotiqGripper("/dev/no-such-port")
    with RobotiqGripper(device.port), pytest.raises(LineError, match="cannot be opened"):
        RobotiqGripper(device.port)


def test_another_kind_of_device_is_refused_not_believed(device: FakeRobotiq) -> None:
    with RobotiqGripper(device.port, timeout=0.03, retries=0, device=3) as other, pytest.raises(NoAnswerError):
        other.status()
    with RobotiqGripper(device.port, timeout=5.0) as gripper, pytest.raises(RefusedError, match="no such register"):
        gripper._open_client.read(0x1000, 1)


def test_fingers_that_never_arrive_are_told_to_stand_still(gripper: RobotiqGripper, device: FakeRobotiq) -> None:
    device.hurry = 1e-3
    gripper.move(0.0)
    with pytest.raises(GripperError, match="still moves"):
        gripper.wait(0.2)
    assert not device.commanded.go
    assert gripper.unsafe


def test_the_larger_model_has_its_own_stroke() -> None:
    with FakeRobotiq("2f-140", hurry=HURRY) as device, RobotiqGripper(device.port, "2f-140", timeout=5.0) as gripper:
        gripper.activate()
        gripper.move(0.12)
        gripper.wait()
        assert gripper.opening() == pytest.approx(0.12, abs=4e-4)
        assert gripper.status().fingers is Fingers.THERE
