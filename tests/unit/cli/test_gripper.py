"""`splatbot gripper`, with a gripper that is not there."""

from __future__ import annotations

from splatbot.robots.grippers import FakeRobotiq
from tests.unit.cli.conftest import RunCommand, assert_fix_named


def test_it_closes_on_an_object_and_says_so(run: RunCommand) -> None:
    with FakeRobotiq(width=0.03, hurry=20.0) as device:
        answer = run("gripper", "close", "--port", device.port, "--force", "40")
        assert answer.code == 0
        assert "hold something" in answer.out
        assert "30.0 of 85 mm" in answer.out or "29.8 of 85 mm" in answer.out or "30.2 of 85 mm" in answer.out
        answer = run("gripper", "status", "--port", device.port)
        assert "hold something" in answer.out
        answer = run("gripper", "open", "--port", device.port)
        assert "85.0 of 85 mm" in answer.out


def test_a_fake_one_needs_no_port(run: RunCommand) -> None:
    answer = run("gripper", "status", "--fake")
    assert answer.code == 0
    assert "reset" in answer.out


def test_wrong_words_are_one_line_that_says_what_to_give(run: RunCommand) -> None:
    for words, text in (
        (("status",), "--port"),
        (("status", "--fake", "--port", "/dev/x"), "--port"),
        (("close", "--fake", "--opening", "0.1"), "--opening"),
        (("move", "--fake"), "--opening"),
        (("move", "--fake", "--opening", "0.3"), "opening"),
    ):
        answer = run("gripper", *words)
        assert_fix_named(answer, text)
    answer = run("gripper", "status", "--port", "/dev/no-such-port")
    assert answer.code == 1
    assert "cannot be opened" in answer.err
