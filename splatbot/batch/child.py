"""The process of one item: `python -m splatbot.batch.child WORDS` is `splatbot WORDS`, and ends with its supervisor."""

from __future__ import annotations

import os
import runpy
import threading

INTERRUPTED = 130
"""Exit code of a command that was cut off."""


def _end_with_supervisor() -> None:
    """Wait until no process holds the other end of stdin, which is also so after SIGKILL, and exit."""
    while os.read(0, 1):
        pass
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    threading.Thread(target=_end_with_supervisor, daemon=True).start()
    runpy.run_module("splatbot", run_name="__main__")
