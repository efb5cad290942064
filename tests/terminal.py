"""A pseudo-terminal for tests: users have a terminal, while most tests use a pipe."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import sys
import termios
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

_TIMEOUT_S = 240
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_COLOURS = re.compile(r"\x1b\[(?:\d+;)*(?:3[0-7]|9[0-7]|38|4[0-7])(?:;\d+)*m")


@dataclass(frozen=True)
class Shown:
    """Exit code and output of a command at a terminal."""

    code: int
    raw: str

    @property
    def text(self) -> str:
        """The characters without escape sequences."""
        return _ESCAPES.sub("", self.raw)

    @property
    def colours(self) -> list[str]:
        """The escape sequences that set a colour."""
        return _COLOURS.findall(self.raw)

    @property
    def live(self) -> bool:
        """Return whether a display was redrawn in place."""
        return "\x1b[" in self.raw and ("\r" in self.raw or "\x1b[2K" in self.raw)

    def longest_line(self) -> int:
        """Return the length [characters] of the longest line as it was drawn, without words that must not be broken."""
        lines = re.split(r"[\r\n]+", self.text)
        breakable = [line for line in lines if not any(len(word) > 40 for word in line.split())]
        return max((len(line.rstrip()) for line in breakable), default=0)


def at_a_terminal(
    *words: str,
    columns: int,
    interrupt_at: str | None = None,
    interrupt_when: Callable[[], bool] | None = None,
    resize_at: tuple[str, int] | None = None,
    environment: Mapping[str, str] | None = None,
    cwd: Path | None = None,
) -> Shown:
    """Run ``splatbot WORDS`` under a pseudo-terminal.

    Args:
        words: of the command.
        columns: width of the terminal.
        interrupt_at: press Ctrl-C once this text is shown.
        interrupt_when: press Ctrl-C once this is true.
        resize_at: text at which the terminal gets another width.
        environment: additional variables.
        cwd: working directory.
    """
    child, terminal = pty.fork()
    if child == 0:
        try:
            if cwd is not None:
                os.chdir(cwd)
            _resize(0, columns)
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # background jobs inherit that it is ignored
            values = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR")}
            values |= {"TERM": "xterm-256color", "OMP_NUM_THREADS": "1", **(environment or {})}
            os.execve(sys.executable, [sys.executable, "-m", "splatbot", *words], values)
        finally:
            os._exit(127)  # only reached when exec failed
    shown, started = b"", time.monotonic()
    try:
        while time.monotonic() - started < _TIMEOUT_S:
            if interrupt_when is not None and interrupt_when():
                os.write(terminal, b"\x03")
                interrupt_when = None
            if not select.select([terminal], [], [], 0.2)[0]:
                continue
            try:
                piece = os.read(terminal, 4096)
            except OSError:  # Linux reports EIO when the child has closed its side
                break
            if not piece:
                break
            shown += piece
            if interrupt_at is not None and interrupt_at.encode() in shown:
                os.write(terminal, b"\x03")
                interrupt_at = None
            if resize_at is not None and resize_at[0].encode() in shown:
                _resize(terminal, resize_at[1])
                resize_at = None
        else:
            os.kill(child, signal.SIGKILL)
            pytest.fail(f"no end after {_TIMEOUT_S} s: {shown[-500:]!r}")
    finally:
        os.close(terminal)
        status = os.waitpid(child, 0)[1]
    return Shown(os.waitstatus_to_exitcode(status), shown.decode(errors="replace"))


def _resize(terminal: int, columns: int) -> None:
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
