"""Masks of a log in TUM layout, which exclude pixels such as those that show the robot itself."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.logs.images import read_mask
from splatbot.logs.index import MAX_STAMP_DIFFERENCE_S, IndexEntry, read_index

Mask = NDArray[np.bool_]


class MaskSource(Protocol):
    """Source of the masks of a log."""

    def at(self, stamp: float) -> Mask:
        """Return the mask (H, W) of the image at a stamp [s]; True for valid pixels."""
        ...


class FixedMask:
    """One mask for all frames: `mask.png`."""

    def __init__(self, path: Path) -> None:
        self._mask = read_mask(path)

    def at(self, stamp: float) -> Mask:
        """Return the mask; it does not depend on the stamp."""
        return self._mask


class ListedMasks:
    """A mask for each frame: `mask.txt`, lines `stamp path` as in depth.txt."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entries = read_index(path)
        self._stamps = np.array([entry.stamp for entry in self._entries])

    def at(self, stamp: float) -> Mask:
        """Return the mask nearest in time.

        Raises:
            LogError: no mask is within 0.02 s, or the mask cannot be read.
        """
        entry = self._nearest(stamp)
        if abs(entry.stamp - stamp) > MAX_STAMP_DIFFERENCE_S:
            raise LogError(
                f"no mask within {MAX_STAMP_DIFFERENCE_S} s of stamp {stamp:.6f}.",
                file=self._path,
                field="stamps",
                hint="list a mask for every image (white where it may be used), or give one `mask.png` for all",
            )
        return read_mask(self._path.parent / entry.path)

    def _nearest(self, stamp: float) -> IndexEntry:
        return self._entries[int(np.abs(self._stamps - stamp).argmin())]


def find_masks(folder: Path) -> MaskSource | None:
    """Open the masks of a log's folder: `mask.txt`, else `mask.png`, else None.

    Raises:
        LogError: the file is damaged.
    """
    if (folder / "mask.txt").exists():
        return ListedMasks(folder / "mask.txt")
    return FixedMask(folder / "mask.png") if (folder / "mask.png").exists() else None
