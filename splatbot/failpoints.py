"""Points at which a test kills the process: before and after each write, flush and rename.

``SPLATBOT_FAILPOINT=rename:3`` kills it at the third rename, and ``any:17`` at the seventeenth point. ``any:17:torn``
also cuts off a part of the file that is not flushed yet, as a power failure does.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

VARIABLE = "SPLATBOT_FAILPOINT"

_point, _left, _torn = "", 0, False


def arm(choice: str) -> None:
    """Choose the point at which the process is killed, in the format of the variable."""
    global _point, _left, _torn
    _point, _, rest = choice.partition(":")
    _left, _torn = int(rest.partition(":")[0] or 0), rest.endswith(":torn")


def reach(point: str, path: Path | None = None, flushed: int = 0) -> None:
    """End the process with SIGKILL if this is the chosen point.

    Args:
        point: kind of point.
        path: file that is not flushed yet.
        flushed: bytes at its begin that were flushed earlier, which a power failure leaves.
    """
    global _left
    if point != _point and _point != "any":
        return
    _left -= 1
    if _left != 0:
        return
    if _torn and path is not None and path.is_file():
        os.truncate(path, flushed + (path.stat().st_size - flushed) * 2 // 3)
    os.kill(os.getpid(), signal.SIGKILL)


arm(os.environ.get(VARIABLE, ""))
