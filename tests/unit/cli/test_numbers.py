"""Options of several numbers: the errors name the option, the count and an example."""

from __future__ import annotations

import re

import pytest

from tests.terminal import at_a_terminal
from tests.unit.cli.conftest import RunCommand, assert_fix_named

_PLAN = ("plan", "--map", "absent.ply", "--start", "home", "--goal", "home")
_FIX = "give 7 numbers, X Y Z QW QX QY QZ, as in --base 0 0.4 0 0.7071 -0.7071 0 0"


@pytest.mark.parametrize(
    ("values", "mistake"),
    [
        (("0.1", "0.2", "0.3"), "--base: has 3 values, not 7."),
        ((), "--base: has 0 values, not 7."),
        (("0", "0", "0", "1", "0", "0", "0", "0"), "--base: has 8 values, not 7."),
        (("0", "-1e-3", "0", "1", "0", "0", "east"), "--base: has 'east', which is no number."),
    ],
)
@pytest.mark.parametrize("last", [True, False])
def test_a_pose_of_another_count_names_option_count_and_example(
    run: RunCommand, values: tuple[str, ...], mistake: str, last: bool
) -> None:
    words = (*_PLAN, "--base", *values) if last else (_PLAN[0], "--base", *values, *_PLAN[1:])
    answer = run(*words)
    assert_fix_named(answer, mistake)
    assert _FIX in answer.err
    assert "FLOAT" not in answer.err


@pytest.mark.parametrize(
    ("command", "flag", "count"),
    [
        ("render", "--pose", 7),
        ("render", "--look-from", 3),
        ("render", "--look-at", 3),
        ("objects", "--base", 7),
        ("twin", "--base", 7),
        ("plan", "--goal-pose", 7),
        ("info", "--up", 3),
        ("info", "--base-offset", 3),
        ("grasp", "--pixel", 2),
        ("grasp", "--point", 3),
        ("grasp", "--box", 4),
    ],
)
def test_each_option_of_several_numbers_has_an_example_that_can_be_copied(
    run: RunCommand, command: str, flag: str, count: int
) -> None:
    answer = run(command, flag, "1")
    assert_fix_named(answer, f"{flag}: has 1 values, not {count}.")
    example = re.search(rf"as in {flag} (.*)$", answer.err.strip())
    assert example is not None
    assert len([float(word) for word in example[1].split()]) == count


@pytest.mark.parametrize(("command", "flag"), [("render", "--pose"), ("objects", "--base")])
def test_a_map_may_follow_an_option_of_several_numbers(run: RunCommand, command: str, flag: str) -> None:
    answer = run(command, flag, "0", "0", "-1.5", "1", "0", "0", "0", "absent.ply")
    assert_fix_named(answer, "absent.ply")
    assert "values" not in answer.err


def test_negative_numbers_and_those_with_exponents_are_numbers(run: RunCommand) -> None:
    answer = run(*_PLAN, "--base", "-0.1", "-1e-3", "+2", "1", "0", "0", "-0")
    assert_fix_named(answer, "absent.ply")  # the next check, of the map


def test_the_help_is_shown_next_to_a_wrong_number(run: RunCommand) -> None:
    answer = run("plan", "--base", "1", "--help")
    assert answer.code == 0
    assert "Examples:" in answer.out


def test_a_short_pose_is_named_at_a_terminal_of_60_columns() -> None:
    shown = at_a_terminal(*_PLAN, "--base", "1", "2", columns=60)
    assert shown.code == 2, shown.text
    assert _FIX in " ".join(shown.text.split())
    assert shown.longest_line() <= 60
