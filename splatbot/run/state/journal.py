"""A file of arrays that only grows: what is saved once, keyframes' images, is not written again by the next save."""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import FormatError
from splatbot.run.state.pixels import Packed, pack, unpack

Array = NDArray[Any]
Entry = list[Any]
"""[offset, size, CRC-32, packing, dtype, shape] of one array in the file."""

_SPARE = 0.5  # share of bytes that nobody refers to, from which the journal is written anew
_HINT = "restore the folder from a copy, or map the log again"


@dataclass
class Journal:
    """Arrays appended to ``folder/images-N.bin``; the state file names the journal and the entries that are in use.

    Args:
        folder: of the state.
        number: N of the file that is written now; a journal is never changed, only appended to or replaced by the next.
    """

    folder: Path
    number: int = 0
    _entries: dict[int, tuple[object, int, Entry]] = field(default_factory=dict)
    _used: set[int] = field(default_factory=set)
    _end: int = 0

    @property
    def path(self) -> Path:
        """The file in use."""
        return self.folder / f"images-{self.number}.bin"

    def begin(self) -> None:
        """A save begins; forgets which entries the one before has used, and tidies up when too much is unused."""
        live = sum(self._entries[key][2][1] for key in self._used if key in self._entries)
        if self._end and live < (1.0 - _SPARE) * self._end:
            self._entries.clear()
            self.number, self._end = self.number + 1, 0
        self._used = set()

    def put(self, owner: object, array: Array) -> Entry:
        """Append an array unless its owner, which is not changed in place, has been appended before."""
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
        """Let what was appended reach the disk; to be called before a state file refers to it."""
        if self._end:
            with self.path.open("r+b") as file:
                os.fsync(file.fileno())

    def finish(self) -> None:
        """The state file is in place: forget arrays that are gone, remove journals that nobody refers to."""
        self._entries = {key: value for key, value in self._entries.items() if key in self._used}
        for path in self.folder.glob("images-*.bin"):
            if path != self.path:
                path.unlink(missing_ok=True)


def read_entry(path: Path, entry: Entry) -> Array:
    """One array of a journal.

    Raises:
        FormatError: the file is missing, cut off or altered.
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
        raise FormatError(f"holds no array ({error}).", file=path, field=f"byte {offset}", hint=_HINT) from error
