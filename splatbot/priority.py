"""Thread priorities on a machine with few cores, and the switch interval of the shared interpreter."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress

_SWITCH_S = 5e-4  # a tenth of Python's own


def lower_priority(niceness: int) -> None:
    """Give the calling thread, and those that it will start, a lower priority than the process began with.

    Without the privilege nothing gives it back. Elsewhere than on Linux a priority is not a thread's own: nothing
    changes.

    Args:
        niceness: 0..19; at 10 its share is a ninth of that of a thread at 0 that wants the same core.
    """
    if sys.platform == "linux":
        with suppress(OSError):  # lower already
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)


def switch_quickly() -> None:
    """Let a thread that wants the interpreter wait half a millisecond for it, not five, while another holds it."""
    sys.setswitchinterval(min(sys.getswitchinterval(), _SWITCH_S))
