"""The driver of Feetech servos on a serial port behind which a servo speaks the same bytes, on good and bad lines."""

from __future__ import annotations

import logging
import os
import pty
import threading
import time
import tty
from collections.abc import Iterator

import numpy as np
import pytest

from splatbot.errors import GripperError, InputError
from splatbot.protocols import Gripper
from splatbot.robots.grippers import FakeFeetech, FeetechGripper, JawCalibration, LineFaults
from splatbot.robots.grippers.errors import FaultError, LineError, NoAnswerError
from tests.devices.lines import emulate_timeouts, wait_for_rest
from tests.waiting import until

JAW = JawCalibration(closed=2030, opened=3330, stroke=0.10, force=20.0)
COUNT_M = 1.1e-4  # [m] largest opening of one count
HURRY = 20.0


@pytest.fixture
def device() -> Iterator[FakeFeetech]:
    with FakeFeetech(JAW, hurry=HURRY) as one:
        yield one


@pytest.fixture
def gripper(device: FakeFeetech) -> Iterator[FeetechGripper]:
    """A driver that waits long for answers, which a busy machine gives late."""
    with FeetechGripper(device.port, JAW, timeout=5.0) as one:
        one.activate()
        yield one


@pytest.fixture
def hasty(device: FakeFeetech, monkeypatch: pytest.MonkeyPatch) -> Iterator[FeetechGripper]:
    """A driver that waits briefly, for lines without good answers."""
    emulate_timeouts(monkeypatch, device)
    with FeetechGripper(device.port, JAW, timeout=0.03) as one:
        one.activate()
        yield one


@pytest.mark.parametrize("shape", ["pivot", "linear"])
@pytest.mark.parametrize("ends", [(2030, 3330), (3330, 2030)])
def test_it_activates_moves_and_reports_its_opening(shape: str, ends: tuple[int, int]) -> None:
    jaw = JawCalibration(*ends, 0.10, 20.0, shape)  # type: ignore[arg-type]
    with FakeFeetech(jaw, hurry=HURRY) as device, FeetechGripper(device.port, jaw, timeout=5.0) as gripper:
        assert isinstance(gripper, Gripper)
        gripper.activate()
        for opening in (0.03, 0.0, 0.10, 0.0501):
            gripper.move(opening)
            gripper.wait()
            assert gripper.opening() == pytest.approx(opening, abs=COUNT_M)
            assert not gripper.holds()
        assert gripper.repeated == 0


def test_force_and_speed_reach_the_memory_within_their_range(gripper: FeetechGripper, device: FakeFeetech) -> None:
    gripper.move(0.04, force=10.0, speed=0.02)
    half = np.pi * 1300 / 4096  # of the angle between the ends; L = stroke / (2 sin half)
    counts = 0.02 / (0.10 / (2 * np.sin(half))) * 4096 / (2 * np.pi)
    seen = device.commanded
    assert (seen.torque, seen.speed) == (500, int(counts))
    for force, speed, expected in ((1e3, 1e3, (750, 3000)), (1e-3, 1e-6, (100, 50)), (None, None, (250, 3000))):
        gripper.move(0.04, force=force, speed=speed)
        assert (device.commanded.torque, device.commanded.speed) == expected


def test_a_jaw_stops_at_an_object_and_holds_it(gripper: FeetechGripper, device: FakeFeetech) -> None:
    device.width = 0.05
    gripper.move(0.0, force=4.0)
    gripper.wait()
    assert gripper.holds()
    assert gripper.opening() == pytest.approx(0.05, abs=COUNT_M)
    assert abs(gripper.status().load) == 200
    gripper.stop()
    assert gripper.holds()  # a stop does not drop it
    device.width = 0.0  # it slips out: the jaw goes on
    until(lambda: gripper.opening() == 0.0, 10.0)
    gripper.wait()
    assert not gripper.holds()


def test_a_stop_from_another_thread_keeps_the_present_position(gripper: FeetechGripper, device: FakeFeetech) -> None:
    device.hurry = 1.0
    gripper.move(0.0, speed=0.02)
    stopper = threading.Timer(0.3, gripper.stop)
    stopper.start()
    gripper.wait(30.0)
    stopper.join()
    at = gripper.opening()
    assert 0.02 < at < 0.10
    assert not gripper.moving()
    time.sleep(0.05)
    assert gripper.opening() == at


def test_an_activation_moves_nothing_and_drops_nothing(device: FakeFeetech) -> None:
    device.width = 0.05
    with FeetechGripper(device.port, JAW, timeout=5.0) as first:
        with pytest.raises(GripperError, match="not activated"):
            first.move(0.01)
        first.activate()
        assert device.commanded.goal == JAW.opened
        first.move(0.0)
        first.wait()
    with FeetechGripper(device.port, JAW, timeout=5.0) as second:
        writes = sum(request[4] == 3 for request in device.requests)
        second.activate()
        assert sum(request[4] == 3 for request in device.requests) == writes
        assert second.holds()


def test_a_released_jaw_must_be_activated(gripper: FeetechGripper, device: FakeFeetech) -> None:
    gripper.release()
    assert not device.commanded.enabled
    assert gripper.status().position == JAW.opened  # for a calibration by hand
    with pytest.raises(GripperError, match="torque was switched off"):
        gripper.move(0.02)
    gripper.activate()
    gripper.move(0.02)


def test_values_out_of_range_are_named(gripper: FeetechGripper, device: FakeFeetech) -> None:
    requests = len(device.requests)
    for opening, force, speed, name in ((-0.01, None, None, "opening"), (0.11, None, None, "opening"),
                                        (np.nan, None, None, "opening"), (0.01, 0.0, None, "force"),
                                        (0.01, None, -1.0, "speed")):  # fmt: skip
        with pytest.raises(InputError, match=name):
            gripper.move(opening, force=force, speed=speed)
    assert len(device.requests) == requests
    with pytest.raises(InputError, match="device"):
        FeetechGripper(device.port, JAW, device=254)
    with pytest.raises(InputError, match="hold_load"):
        FeetechGripper(device.port, JAW, hold_load=0.1)
    with pytest.raises(InputError, match="timeout, retries"):
        FeetechGripper(device.port, JAW, retries=-1)


@pytest.mark.parametrize(
    ("bits", "text"),
    [(0x01, "voltage"), (0x02, "encoder"), (0x04, "too hot"), (0x08, "current"), (0x24, "too hot, it was overloaded")],
)
def test_a_fault_is_an_error_that_names_it_and_stops_the_jaw(
    gripper: FeetechGripper, device: FakeFeetech, bits: int, text: str
) -> None:
    device.hurry = 0.5
    gripper.move(0.0)
    device.error = bits
    with pytest.raises(FaultError, match=text) as caught:
        gripper.wait()
    assert caught.value.fault == bits
    assert device.commanded.goal > JAW.closed  # the present position
    with pytest.raises(GripperError, match="takes no move"):
        gripper.move(0.02)
    if bits & ~0x20:
        with pytest.raises(FaultError):  # it persists
            gripper.activate()
    device.error &= 0x20
    gripper.activate()  # clears the overload
    gripper.move(0.02)
    gripper.status()


def test_a_servo_that_lost_its_command_is_an_error_and_not_at_its_goal(
    gripper: FeetechGripper, device: FakeFeetech
) -> None:
    gripper.move(0.05)
    gripper.wait()
    device.restart()
    with pytest.raises(GripperError, match="does not execute the last command"):
        gripper.holds()
    gripper.activate()
    gripper.move(0.03)
    gripper.wait()


@pytest.mark.parametrize(("address", "value", "text"), [(3, 4, "model 772"), (33, 1, "operating mode 1")])
def test_another_servo_or_mode_is_refused(device: FakeFeetech, address: int, value: int, text: str) -> None:
    device.memory[address] = value
    with FeetechGripper(device.port, JAW, timeout=5.0) as gripper, pytest.raises(GripperError, match=text):
        gripper.activate()
    assert all(request[4] == 2 for request in device.requests)  # nothing was written


def test_a_thousand_commands_on_a_line_that_loses_bytes_end_done_or_as_an_error(
    device: FakeFeetech, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    emulate_timeouts(monkeypatch, device)
    rng = np.random.default_rng(5)
    with FeetechGripper(device.port, JAW, timeout=0.008, retries=2) as gripper:
        gripper.activate()
        device.faults = LineFaults(drop=0.003, flip=0.001, half=0.02)
        done = failed = 0
        with caplog.at_level(logging.INFO, logger="splatbot"):
            for k in range(1000):
                opening = float(rng.uniform(0.0, gripper.stroke))
                try:
                    gripper.move(opening)
                    status = gripper.status()
                    # The status refers to this command, not to an earlier one.
                    assert status.command.goal == JAW.count(opening)
                    assert device.commanded.goal == JAW.count(opening)
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
    "faults",
    [
        LineFaults(silent=True),
        LineFaults(drop=1.0),
        LineFaults(half=1.0),
        LineFaults(flip=1.0),
        LineFaults(delay=0.2),
    ],
    ids=["silent", "drops", "halves", "flips", "late"],
)
def test_a_line_that_never_gives_a_good_answer_is_a_typed_error_after_bounded_tries(
    hasty: FeetechGripper, device: FakeFeetech, faults: LineFaults
) -> None:
    device.faults = faults
    with pytest.raises(NoAnswerError, match="no good answer to 5 tries"):
        hasty.move(0.01)
    device.faults = LineFaults()
    wait_for_rest(device)
    with pytest.raises(GripperError, match="takes no move"):
        hasty.move(0.02)
    hasty.activate()
    hasty.move(0.02)
    hasty.wait()
    assert hasty.opening() == pytest.approx(0.02, abs=COUNT_M)


def test_an_adapter_that_echoes_is_an_error_and_not_believed() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    ended = threading.Event()

    def echo() -> None:
        while not ended.is_set():
            try:
                os.write(master, os.read(master, 256))
            except OSError:
                return

    thread = threading.Thread(target=echo, daemon=True)
    thread.start()
    with FeetechGripper(os.ttyname(slave), JAW, timeout=5.0, retries=1) as gripper:
        with pytest.raises(NoAnswerError, match="echo"):
            gripper.activate()
        with pytest.raises(NoAnswerError, match="echo of the request"):
            gripper._open_client.read(3, 2)  # as long as its response
    ended.set()
    os.write(slave, b"x")
    thread.join()
    os.close(master)
    os.close(slave)


def test_an_unplugged_gripper_is_a_typed_error_and_its_port_is_given_back(
    gripper: FeetechGripper, device: FakeFeetech
) -> None:
    gripper.move(0.01)
    device.unplug()
    with pytest.raises(LineError, match="is gone"):
        gripper.wait()
    for call in (gripper.opening, gripper.holds, gripper.stop, gripper.moving, gripper.release):
        with pytest.raises(LineError, match="not open"):
            call()
    with pytest.raises(LineError, match="cannot be opened"):
        gripper.activate()
    gripper.close()


def test_a_port_that_is_not_there_or_taken_is_named(device: FakeFeetech) -> None:
    with pytest.raises(LineError, match="no-such-port: cannot be opened"):
        FeetechGripper("/dev/no-such-port", JAW)
    with FeetechGripper(device.port, JAW), pytest.raises(LineError, match="cannot be opened"):
        FeetechGripper(device.port, JAW)


def test_another_servo_on_the_line_does_not_answer(device: FakeFeetech) -> None:
    with (
        FeetechGripper(device.port, JAW, timeout=0.03, retries=0, device=5) as other,
        pytest.raises(NoAnswerError, match="device 5"),
    ):
        other.activate()


def test_a_jaw_that_never_arrives_is_stopped(gripper: FeetechGripper, device: FakeFeetech) -> None:
    device.hurry = 1e-2
    gripper.move(0.0)
    with pytest.raises(GripperError, match="still moves"):
        gripper.wait(0.2)
    assert device.commanded.goal > JAW.closed
    assert gripper.unsafe
