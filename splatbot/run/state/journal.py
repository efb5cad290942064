"""Append-only file of arrays: images of keyframes are written once, not at every save."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import sync, sync_folder
from splatbot.errors import FormatError
from splatbot.run.state.pixels import Packed, pack, unpack

Array = NDArray[Any]
Entry = list[Any]
"""[offset, size, CRC-32, packing, dtype, shape] of one array in the file."""

_UNUSED_SHARE = 0.5  # unused share of the bytes from which the journal is written again
_HINT = "restore the folder from a copy, or map the log again"


@dataclass
class Journal:
    """Arrays appended to ``folder/images-N.bin``; the state file lists the journal and the entries in use.

    Args:
        folder: of the state.
        number: N of the current file. A journal is only appended to, or replaced by the next one.
    """

    folder: Path
    number: int = 0
    _entries: dict[int, tuple[object, int, Entry]] = field(default_factory=dict)
    _used: set[int] = field(default_factory=set)
    _end: int = 0
    _flushed: int = 0

    @property
    def path(self) -> Path:
        """Path of the current file."""
        return self.folder / f"images-{self.number}.bin"

    def begin(self) -> None:
        """Begin a save; start a new file if too many bytes of the current one are unused."""
        live = sum(self._entries[key][2][1] for key in self._used if key in self._entries)
        if self._end and live < (1.0 - _UNUSED_SHARE) * self._end:
            self._entries.clear()
            self.number, self._end, self._flushed = self.number + 1, 0, 0
        self._used = set()

    def put(self, owner: object, array: Array) -> Entry:
        """Append an array and return its entry; an unchanged owner keeps its earlier entry."""
        version = getattr(owner, "_version", 0)  # torch counts changes in place
        known = self._entries.get(id(owner))
        self._used.add(id(owner))
        if known is not None and known[1] == version:
            return known[2]
        packed = pack(array, compress=True)
        with self.path.open("r+b" if self._end else "wb") as file:
            file.seek(self._end)
            file.write(packed.data)
        entry = [self._end, len(packed.data), zlib.crc32(packed.data), packed.packing, packed.dtype, packed.shape]
        self._end += len(packed.data)
        self._entries[id(owner)] = (owner, version, entry)  # holding the owner keeps its id its own
        return entry

    def sync(self) -> None:
        """Flush the appended arrays to the disk; needed before a state file refers to them."""
        if self._end:
            with self.path.open("r+b") as file:
                sync(file, flushed=self._flushed)
            self._flushed = self._end
            sync_folder(self.folder)

    def finish(self) -> None:
        """End a save: forget unused arrays and remove journals that the state file does not refer to."""
        self._entries = {key: value for key, value in self._entries.items() if key in self._used}
        for path in self.folder.glob("images-*.bin"):
            if path != self.path:
                path.unlink(missing_ok=True)


def read_entry(path: Path, entry: Entry) -> Array:
    """Read one array of a journal.

    Raises:
        FormatError: The file is missing, truncated or altered.
    """
    try:
        offset, size, checksum, packing, dtype, shape = entry
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(size)
    except (OSError, ValueError, TypeError) as error:
        raise FormatError(f"cannot be read ({error}).", file=path, hint=_HINT) from error
    if len(data) != size:
        raise FormatError("is cut off.", file=path, field=f"byte {offset}", hint=_HINT)
    if zlib.crc32(data) != checksum:
        raise FormatError("is damaged: a checksum does not fit.", file=path, field=f"byte {offset}", hint=_HINT)
    try:
        return np.asarray(unpack(Packed(data, packing, dtype, shape)))
    except (ValueError, TypeError) as error:
        raise FormatError(f"is not an array ({error}).", file=path, field=f"byte {offset}", hint=_HINT) from error
