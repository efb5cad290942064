"""Errors: one hierarchy, and messages that name the place and a fix."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from splatbot import errors
from splatbot.errors import InputError, LogError, SplatbotError

OWN = [c for _, c in inspect.getmembers(errors, inspect.isclass) if c.__module__ == errors.__name__]
CLASSES = [c for c in OWN if not issubclass(c, Warning)]


def test_the_message_names_file_field_and_fix() -> None:
    error = LogError("is empty.", file=Path("a/rgb.txt"), field="line 3", hint="write it")
    assert str(error) == "a/rgb.txt: line 3: is empty. Fix: write it"
    assert (error.message, error.file, error.field, error.hint) == ("is empty.", "a/rgb.txt", "line 3", "write it")


def test_parts_that_are_unknown_leave_no_trace() -> None:
    assert str(InputError("is empty.")) == "is empty."
    assert str(InputError("is empty.", field="rgb")) == "rgb: is empty."


@pytest.mark.parametrize("kind", CLASSES)
def test_every_error_is_in_the_tree_and_has_an_answer_for_each_interface(kind: type[SplatbotError]) -> None:
    assert issubclass(kind, SplatbotError)
    assert 400 <= kind.http_status < 600
    assert kind.exit_code in (1, 2)
    assert issubclass(kind, InputError) <= (kind.exit_code == 2)
