"""Transfers of one file without long waits, which tests can stop."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbot.downloads import Patience
from splatbot.downloads.transfer import fetch

CONTENT = np.random.default_rng(7).bytes(300_000)
PATIENCE = Patience(attempts=3, first_wait=0.0, timeout=2.0)


class StoppedError(Exception):
    """Ends a transfer, as Ctrl-C does."""


def get(
    url: str,
    target: Path,
    *,
    size: int | None = None,
    stop_at: int | None = None,
    patience: Patience = PATIENCE,
) -> list[str]:
    """Fetch a file, and return the sentences before the waits."""
    notices: list[str] = []

    def progress(done: int, total: int | None) -> None:
        if stop_at is not None and done >= stop_at:
            raise StoppedError

    fetch(
        url,
        target,
        size=size,
        room=lambda total, here: 1 << 20,
        progress=progress,
        notice=notices.append,
        patience=patience,
    )
    return notices
