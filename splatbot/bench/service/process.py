"""Memory and processor time of another process."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path


def resident_mib(process: subprocess.Popen[str]) -> float | None:
    """Return the resident memory of a process [MiB]. If None, the system does not report it."""
    try:
        lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS")), None)


def cpu_seconds(process: subprocess.Popen[str]) -> float | None:
    """Return the processor time of a process [s]. If None, the system does not report it."""
    try:
        stat = Path(f"/proc/{process.pid}/stat").read_text()
    except OSError:
        return None
    user, system = stat.rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
