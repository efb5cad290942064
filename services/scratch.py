"""Folders for files of one request or job; those of killed services are removed at the next start."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from contextlib import suppress
from pathlib import Path

_PREFIXES = ("splatbot-upload-", "splatbot-export-")
_AGE_S = 60.0  # a younger folder may not be locked yet


class Scratch:
    """A new folder among the temporary files, locked while this process lives.

    Args:
        purpose: "upload" or "export".
    """

    def __init__(self, purpose: str) -> None:
        self.path = Path(tempfile.mkdtemp(prefix=f"splatbot-{purpose}-"))
        self._descriptor = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC)
        fcntl.flock(self._descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)

    def discard(self) -> None:
        """Remove the folder and its files."""
        shutil.rmtree(self.path, ignore_errors=True)
        with suppress(OSError):  # discarded before
            os.close(self._descriptor)
        self._descriptor = -1


def sweep_scratch() -> None:
    """Remove the folders that no living process has locked."""
    for path in Path(tempfile.gettempdir()).glob("splatbot-*"):
        if not path.name.startswith(_PREFIXES) or path.is_symlink() or not path.is_dir():
            continue
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _AGE_S and _is_free(path):
                shutil.rmtree(path, ignore_errors=True)


def _is_free(path: Path) -> bool:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(descriptor)
    return True
