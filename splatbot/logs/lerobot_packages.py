"""Packages that LeRobot datasets need: parquet tables and video."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from splatbot.errors import LogError


def require_lerobot(source: str | Path) -> None:
    """Check that the packages of the extra `lerobot` are installed.

    Raises:
        LogError: one is missing.
    """
    missing = [name for name in ("pyarrow", "av") if find_spec(name) is None]
    if missing:
        problem = f"needs the package {' and '.join(missing)}."
        raise LogError(problem, file=source, field="log", hint="pip install 'splatbot[lerobot]'")
