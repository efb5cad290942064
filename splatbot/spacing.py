"""Even choices of few items from many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def evenly_spaced(items: Sequence[T], most: int) -> list[T]:
    """Return at most ``most`` evenly spaced items, with the first and the last one."""
    count = min(most, len(items))
    return [items[k] for k in np.linspace(0, len(items) - 1, count).round().astype(int)]
