"""Log lines of the service."""

from __future__ import annotations

import json
import logging
import sys

from splatbot.services.requests import JsonFormatter, TextFormatter, request_id


def _record(message: str, *args: object, error: bool = False) -> logging.LogRecord:
    found = None
    if error:
        try:
            raise ValueError("broken\nin two lines")
        except ValueError:
            found = sys.exc_info()
    return logging.LogRecord("splatbot.x", logging.WARNING, "file.py", 1, message, args, found)


def test_a_line_of_json_holds_the_message_whatever_is_in_it_and_the_request() -> None:
    token = request_id.set("abc")
    line = JsonFormatter().format(_record('said "%s"', "a\nb", error=True))
    request_id.reset(token)
    told = json.loads(line)
    assert "\n" not in line
    assert (told["message"], told["level"], told["logger"], told["request_id"]) == (
        'said "a\nb"',
        "warning",
        "splatbot.x",
        "abc",
    )
    assert "ValueError: broken" in told["error"]


def test_outside_of_a_request_no_request_is_named() -> None:
    assert "request_id" not in json.loads(JsonFormatter().format(_record("begun")))
    assert TextFormatter("%(levelname)s: %(message)s").format(_record("begun")) == "WARNING: begun"


def test_a_line_of_text_ends_with_its_request() -> None:
    token = request_id.set("abc")
    line = TextFormatter("%(levelname)s: %(message)s").format(_record("asked"))
    request_id.reset(token)
    assert line == "WARNING: asked [abc]"
