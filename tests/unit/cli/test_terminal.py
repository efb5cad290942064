"""Commands at a terminal: users have a terminal, while most tests use a pipe."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import struct
import sys
import termios
import time
from pathlib import Path

import pytest

LOG = "synthetic:tabletop?frames=12&width=160&height=120"
_TIMEOUT_S = 240


def _at_a_terminal(*words: str, columns: int, interrupt_at: str | None = None) -> tuple[int, str]:
    """Exit code and output of ``splatbot WORDS`` under a pseudo-terminal; Ctrl-C once ``interrupt_at`` is shown."""
    child, terminal = pty.fork()
    if child == 0:
        try:
            fcntl.ioctl(0, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
            environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR")}
            environment |= {"TERM": "xterm-256color", "OMP_NUM_THREADS": "1"}
            os.execve(sys.executable, [sys.executable, "-m", "splatbot", *words], environment)
        finally:
            os._exit(127)  # only reached when exec failed
    shown, started = b"", time.monotonic()
    try:
        while time.monotonic() - started < _TIMEOUT_S:
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
        else:
            os.kill(child, signal.SIGKILL)
            pytest.fail(f"no end after {_TIMEOUT_S} s: {shown[-500:]!r}")
    finally:
        os.close(terminal)
        status = os.waitpid(child, 0)[1]
    return os.waitstatus_to_exitcode(status), shown.decode(errors="replace")


@pytest.mark.parametrize("columns", [80, 200])
def test_map_shows_progress_and_ends_with_its_summary(tmp_path: Path, columns: int) -> None:
    code, shown = _at_a_terminal("map", LOG, "--out", str(tmp_path / "run"), columns=columns)
    assert code == 0, shown
    assert "Traceback" not in shown
    assert "\x1b[" in shown  # a live display, not plain lines
    assert "12/12" in shown
    assert "frames tracked" in shown
    assert (tmp_path / "run" / "report.html").exists()


def test_ctrl_c_at_a_terminal_saves_what_was_mapped(tmp_path: Path) -> None:
    log = LOG.replace("frames=12", "frames=400")
    code, shown = _at_a_terminal("map", log, "--out", str(tmp_path / "run"), columns=80, interrupt_at="/400")
    assert code == 130, shown
    assert "Traceback" not in shown
    assert "interrupted; saved" in shown
    assert (tmp_path / "run" / "map.ply").exists()
