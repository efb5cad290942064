"""Errors, warnings and questions on stderr."""

from __future__ import annotations

import shutil
import sys
import textwrap
from typing import TextIO


def print_message(kind: str, text: object, file: TextIO | None = None) -> None:
    """Print ``kind: text``: one line in a file; at a terminal, lines that fit it.

    Paths and other long words are not broken, so that they can be copied.

    Args:
        kind: "error", "warning" or "question".
        text: the message.
        file: the stream; stderr by default.
    """
    stream = file or sys.stderr
    message = f"{kind}: {text}"
    if stream.isatty():
        columns = shutil.get_terminal_size().columns
        message = "\n".join(
            textwrap.fill(line, columns, break_long_words=False, break_on_hyphens=False)
            for line in message.splitlines()
        )
    print(message, file=stream)
