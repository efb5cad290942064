"""Errors, warnings and questions on stderr."""

from __future__ import annotations

import shutil
import sys
import textwrap
from typing import TextIO

_INTERRUPTED = "interrupted"
_if_interrupted = _INTERRUPTED


def set_interruption(words: str = _INTERRUPTED) -> None:
    """Set the message of a Ctrl-C that ends the process from here on."""
    global _if_interrupted
    _if_interrupted = words


def interruption() -> str:
    """Return the message of a Ctrl-C that ends the process here."""
    return _if_interrupted


def print_message(kind: str, text: object, file: TextIO | None = None) -> None:
    """Print ``kind: text``; see :func:`fitted`.

    Args:
        kind: "error", "warning" or "question".
        text: the message.
        file: the stream; stderr by default.
    """
    stream = file or sys.stderr
    for line in f"{kind}: {text}".splitlines():
        print("\n".join(fitted(line, stream)), file=stream)


def fitted(text: str, stream: TextIO, indent: int = 0) -> list[str]:
    """Return the lines of a text: one in a file; at a terminal, lines that fit it after an indent [characters].

    Paths and other long words are not broken, so that they can be copied.
    """
    if not stream.isatty():
        return [text]
    room = max(shutil.get_terminal_size().columns - indent, 20)
    return textwrap.wrap(text, room, break_long_words=False, break_on_hyphens=False) or [""]
