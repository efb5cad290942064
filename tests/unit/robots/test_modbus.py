"""Frames and registers against the examples of Robotiq's manual (2F-85 & 2F-140, chapter 4.7; 2F-200 edition)."""

from __future__ import annotations

import pytest

from splatbot.errors import GripperError
from splatbot.robots.grippers.line import FramingError
from splatbot.robots.grippers.modbus import crc16, framed, unframed
from splatbot.robots.grippers.registers import Activation, Command, Fingers, Status
from splatbot.robots.grippers.robotiq import MODELS

MANUAL = [  # as printed there
    "09 10 03 E8 00 03 06 00 00 00 00 00 00 73 30",  # reset
    "09 10 03 E8 00 03 01 30",
    "09 03 07 D0 00 01 85 CF",
    "09 03 02 11 00 55 D5",
    "09 03 02 31 00 4C 15",
    "09 04 07 D0 00 03 B1 CE",
    "09 04 06 F9 00 00 00 0D 00 17 AA",
    "09 04 06 B9 00 00 FF BD 00 5C 9A",
    "09 10 03 E8 00 03 06 09 00 00 00 FF FF 72 19",  # open, in full
]


@pytest.mark.parametrize("text", MANUAL)
def test_the_checksums_are_those_of_the_manual(text: str) -> None:
    frame = bytes.fromhex(text)
    assert framed(frame[:-2]) == frame
    assert unframed(frame) == frame[:-2]
    assert crc16(frame) == 0  # a frame with its own checksum leaves nothing


def test_every_single_wrong_bit_is_seen() -> None:
    frame = bytes.fromhex(MANUAL[0])
    for bit in range(8 * len(frame)):
        wrong = bytearray(frame)
        wrong[bit // 8] ^= 1 << bit % 8
        with pytest.raises(FramingError, match="checksum"):
            unframed(bytes(wrong))


def test_commands_are_the_bytes_of_the_manual() -> None:
    data = [bytes.fromhex(text)[7:-2] for text in (MANUAL[0], MANUAL[8])]
    reset = Command(activate=False, go=False, position=0, speed=0, force=0)
    assert [reset.to_bytes(), Command(position=0, speed=255, force=255).to_bytes()] == data
    for one in (reset, Command(position=7, speed=8, force=9, release=True, release_opens=True)):
        assert Command.from_bytes(one.to_bytes()) == one


def test_a_status_says_what_the_manual_says_of_its_bytes() -> None:
    held = Status.from_bytes(bytes.fromhex(MANUAL[7])[3:-2])
    assert held == Status(True, True, Activation.DONE, Fingers.STOPPED_CLOSING, 0, 0xFF, 0xBD, 0)
    opened = Status.from_bytes(bytes.fromhex(MANUAL[6])[3:-2])
    assert (opened.fingers, opened.position, opened.fault_text) == (Fingers.THERE, 13, "")
    assert held.to_bytes() == bytes.fromhex(MANUAL[7])[3:-2]


def test_a_status_that_means_nothing_is_an_error_not_a_guess() -> None:
    with pytest.raises(GripperError, match="undefined value"):
        Status.from_bytes(bytes([0x21, 0, 0, 0, 0, 0]))


def test_openings_and_positions_are_inverse_to_half_a_count() -> None:
    for model in MODELS.values():
        for k in range(1, 100):
            opening = model.stroke * k / 100
            assert model.opening(model.position(opening)) == pytest.approx(opening, abs=0.51 * model.stroke / 217)
        assert (model.position(0.0), model.position(model.stroke)) == (255, 0)
        assert (model.opening(255), model.opening(0)) == (0.0, model.stroke)
