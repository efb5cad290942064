"""Image lists `rgb.txt` and `depth.txt` of the TUM layout, one `stamp path` per line, and their association."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError

MAX_STAMP_DIFFERENCE_S = 0.02  # between associated images, as in TUM's associate.py


@dataclass(frozen=True)
class IndexEntry:
    """One image of a list: stamp [s], path relative to the log, line number."""

    stamp: float
    path: str
    line: int


def read_index(path: Path) -> list[IndexEntry]:
    """Read the entries of a list file in their order; ``#`` starts a comment.

    The whole file is checked at once, so that an error in the last line does not stop a run after an hour of mapping.

    Raises:
        LogError: the file is missing or empty, a line is malformed or the stamps do not increase.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise LogError(
            f"cannot be read ({error.strerror}).", file=path, hint="write it: one line `stamp path` an image"
        ) from error
    entries: list[IndexEntry] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        entry = _parse(path, number, line)
        if entries and entry.stamp <= entries[-1].stamp:
            raise LogError(
                f"stamp {entry.stamp:.6f} is not after {entries[-1].stamp:.6f} of line {entries[-1].line}.",
                file=path,
                field=f"line {number}",
                hint="sort the lines by stamp and drop doubles",
            )
        entries.append(entry)
    if not entries:
        raise LogError(
            "the log is empty: no images are listed.", file=path, hint="write one line `stamp path` an image"
        )
    return entries


def _parse(path: Path, number: int, line: str) -> IndexEntry:
    words = line.strip().split(maxsplit=1)
    try:
        stamp = float(words[0])
    except ValueError:
        stamp = math.nan
    if len(words) != 2 or not math.isfinite(stamp):
        raise LogError(
            f"{line.strip()[:80]!r} is malformed.",
            file=path,
            field=f"line {number}",
            hint="write `stamp path` (seconds, then the image's path inside the log) or remove the line",
        )
    return IndexEntry(stamp, words[1], number)


def associate(a: NDArray[np.float64], b: NDArray[np.float64], max_difference: float) -> list[tuple[int, int]]:
    """Pair the indices of increasing stamps (N,) and (M,) [s] that differ by less than ``max_difference``.

    The pairing is one to one and greedy by the smallest difference, as in TUM's `associate.py`. Pairs are in the order
    of ``a``.
    """
    # The smallest difference among all unpaired stamps is always between neighbours in time.
    order = sorted(
        [(stamp, 0, i) for i, stamp in enumerate(a.tolist())] + [(t, 1, j) for j, t in enumerate(b.tolist())]
    )
    before, after = list(range(-1, len(order) - 1)), list(range(1, len(order) + 1))
    heap: list[tuple[float, int, int, int, int]] = []

    def offer(left: int, right: int) -> None:
        if left < 0 or right >= len(order) or order[left][1] == order[right][1]:
            return
        difference = order[right][0] - order[left][0]
        if difference < max_difference:
            i, j = (order[k][2] for k in sorted((left, right), key=lambda k: order[k][1]))
            heapq.heappush(heap, (difference, i, j, left, right))

    for k in range(len(order) - 1):
        offer(k, k + 1)
    pairs: dict[int, int] = {}
    paired = [False] * len(order)
    while heap:
        _, i, j, left, right = heapq.heappop(heap)
        if paired[left] or paired[right]:
            continue
        pairs[i] = j
        paired[left] = paired[right] = True
        outer_left, outer_right = before[left], after[right]
        if outer_left >= 0:
            after[outer_left] = outer_right
        if outer_right < len(order):
            before[outer_right] = outer_left
        offer(outer_left, outer_right)
    return sorted(pairs.items())
