"""Packets and memory of Feetech's STS servos against bytes of the published protocol, written by hand."""

from __future__ import annotations

import math
import os

import pytest

from splatbot.errors import InputError
from splatbot.robots.grippers import FakeFeetech, JawCalibration
from splatbot.robots.grippers.line import FramingError
from splatbot.robots.grippers.scs import ServoCommand, ServoStatus, packet, unpacked

JAW = JawCalibration(2000, 3400, 0.1, 20.0)

PUBLISHED = [  # examples of FT-SCS, and of a public log of a servo
    ("FF FF 01 02 01 FB", (1, 0x01, "")),  # ping
    ("FF FF 01 04 02 38 02 BE", (1, 0x02, "38 02")),  # read the present position
    ("FF FF 01 04 00 18 05 DD", (1, 0x00, "18 05")),  # 1304
    ("FF FF 01 04 03 28 01 CE", (1, 0x03, "28 01")),  # torque on
    ("FF FF 01 05 03 2A 00 08 C4", (1, 0x03, "2A 00 08")),  # goal 2048
    ("FF FF 01 09 03 2A 00 08 00 00 E8 03 D5", (1, 0x03, "2A 00 08 00 00 E8 03")),  # goal 2048 at 1000 counts/s
    ("FF FF 01 02 00 FC", (1, 0x00, "")),  # done
]


@pytest.mark.parametrize(("text", "fields"), PUBLISHED)
def test_packets_are_the_published_ones(text: str, fields: tuple[int, int, str]) -> None:
    device, code, parameters = fields
    assert packet(device, code, bytes.fromhex(parameters)) == bytes.fromhex(text)
    assert unpacked(bytes.fromhex(text)) == (device, code, bytes.fromhex(parameters))


def test_every_single_wrong_bit_is_found() -> None:
    data = bytes.fromhex(PUBLISHED[5][0])
    for bit in range(8 * len(data)):
        wrong = bytearray(data)
        wrong[bit // 8] ^= 1 << bit % 8
        with pytest.raises(FramingError, match="checksum"):
            unpacked(bytes(wrong))


def test_every_part_of_a_packet_is_refused() -> None:
    data = bytes.fromhex(PUBLISHED[5][0])
    for length in range(len(data)):
        with pytest.raises(FramingError):
            unpacked(data[:length])


def test_a_command_fills_the_bytes_40_to_49_of_the_memory_table() -> None:
    command = ServoCommand(goal=2048, speed=1000, torque=500, acceleration=50)
    assert command.to_bytes() == bytes.fromhex("01 32 00 08 00 00 E8 03 F4 01")
    assert ServoCommand.from_bytes(command.to_bytes()) == command
    assert ServoCommand(goal=-100).to_bytes()[2:4] == bytes.fromhex("64 80")  # a magnitude, and the sign in bit 15


def test_a_status_has_the_fields_of_the_memory_table() -> None:
    block = bytes.fromhex("01 00 D0 07 00 00 E8 03 2C 01 00 00 00 00 00 00 54 08 64 80 2C 05 4A 22 00 20 01")
    status = ServoStatus.from_bytes(block)
    assert status.command == ServoCommand(goal=2000, speed=1000, torque=300)
    assert (status.position, status.speed, status.load) == (2132, -100, -300)  # the sign of the load is bit 10
    assert (status.voltage, status.temperature, status.error, status.moving) == (7.4, 34, 0x20, True)
    assert status.fault_text == "it was overloaded"
    assert status.to_bytes() == block


def test_the_emulator_answers_packets_written_by_hand() -> None:
    with FakeFeetech(JAW, device=1) as servo:
        line = os.open(servo.port, os.O_RDWR | os.O_NOCTTY)
        try:
            for request, response in (
                ("FF FF 01 04 02 38 02 BE", "FF FF 01 04 00 48 0D A5"),  # it is open, at 3400
                ("FF FF 01 04 02 03 02 F3", "FF FF 01 04 00 09 03 EE"),  # model 777
                ("FF FF 01 04 03 28 01 CE", "FF FF 01 02 00 FC"),
                ("FF FF 01 05 03 2A 48 0D 77", "FF FF 01 02 00 FC"),
                ("FF FF 01 04 02 28 04 CC", "FF FF 01 06 00 01 00 48 0D A2"),
                ("FF FF 01 04 02 3E 02 B8", "FF FF 01 04 00 4A 1E 92"),  # 7.4 V, 30 °C
            ):
                os.write(line, bytes.fromhex(request))
                expected = bytes.fromhex(response)
                assert _read(line, len(expected)) == expected
            servo.error = 0x04
            os.write(line, bytes.fromhex("FF FF 01 04 02 38 02 BE"))
            assert _read(line, 8)[4] == 0x04  # the error byte of a response
        finally:
            os.close(line)


def _read(line: int, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += os.read(line, count - len(data))
    return data


def test_a_jaw_on_a_pivot_opens_by_the_chord_of_its_angle() -> None:
    jaw = JawCalibration(closed=2000, opened=2000 + 1024, stroke=0.1 * math.sqrt(2.0), force=20.0)  # 90°, L = 0.1 m
    assert jaw.opening(2000 + 512) == pytest.approx(0.2 * math.sin(math.pi / 8), abs=1e-12)
    for k in range(101):
        opening = jaw.stroke * k / 100
        count = 2 * 2048 / math.pi * math.asin(opening / 0.2)
        assert abs(jaw.count(opening) - 2000 - count) <= 0.5 + 1e-9
    assert (jaw.opening(1900), jaw.opening(4000)) == (0.0, jaw.stroke)
    # At the closed end the opening grows by L for each radian.
    assert jaw.count_speed(0.05) == pytest.approx(0.05 / 0.1 * 4096 / (2 * math.pi))


def test_a_linear_jaw_is_proportional_and_may_close_towards_either_end() -> None:
    jaw = JawCalibration(closed=3000, opened=1000, stroke=0.08, force=20.0, shape="linear")
    assert [jaw.opening(count) for count in (3000, 2000, 1000)] == pytest.approx([0.0, 0.04, 0.08])
    assert [jaw.count(opening) for opening in (0.0, 0.02, 0.08)] == [3000, 2500, 1000]
    assert jaw.count_speed(0.04) == pytest.approx(1000.0)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ((2000, 2050, 0.1, 20.0), "closed, opened"),
        ((0, 3000, 0.1, 20.0), "closed, opened"),  # more than half a turn
        ((-1, 1000, 0.1, 20.0), "closed, opened"),
        ((1000, 2000, math.nan, 20.0), "stroke"),
        ((1000, 2000, 0.1, 0.0), "force"),
        ((1000, 2000, 0.1, math.inf), "force"),
    ],
)
def test_a_calibration_that_is_no_jaw_is_refused(values: tuple[int, int, float, float], name: str) -> None:
    with pytest.raises(InputError, match=name):
        JawCalibration(*values)
    with pytest.raises(InputError, match="shape"):
        JawCalibration(1000, 2000, 0.1, 20.0, shape="scissors")  # type: ignore[arg-type]
