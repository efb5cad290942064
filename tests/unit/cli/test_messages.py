"""Errors and warnings: lines that fit a terminal, one line in a file."""

from __future__ import annotations

import io

import pytest

from splatbot.cli.messages import print_message
from tests.terminal import at_a_terminal

_LONG = "the largest object cannot be grasped because no finger reaches two opposite sides of it " * 3


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_a_message_fits_the_terminal_and_loses_no_word(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    stream = _Terminal()
    print_message("error", _LONG, stream)
    lines = stream.getvalue().splitlines()
    assert max(map(len, lines)) <= columns
    assert " ".join(lines).split() == f"error: {_LONG}".split()


def test_a_message_in_a_file_is_one_line() -> None:
    stream = io.StringIO()
    print_message("warning", _LONG, stream)
    assert stream.getvalue() == f"warning: {_LONG}\n"


def test_a_path_in_a_message_is_not_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    path = "/data/" + "a-long-folder-name/" * 5 + "log.mcap"
    stream = _Terminal()
    print_message("error", f"{path}: has no frame", stream)
    assert path in stream.getvalue()


def test_an_error_of_a_command_fits_the_terminal() -> None:
    shown = at_a_terminal("plan", "--map", "absent", "--start", "home", "--goal", "home", columns=60)
    assert shown.code == 2, shown.text
    assert "error:" in shown.text
    assert shown.longest_line() <= 60, shown.text
