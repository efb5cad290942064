"""Images that a parquet file of a LeRobot dataset embeds: PNG or JPEG colour, TIFF or PNG depth (LeRobot 0.6)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.logs.base import MILLIMETRES
from splatbot.logs.image_size import image_size
from splatbot.logs.images import decode_color, depth_in_metres
from splatbot.logs.lerobot_tables import DAMAGED, check_type, column_type, open_parquet

_BATCH = 16  # rows that are in memory at once
_BYTES = (pa.binary(), pa.large_binary())
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257  # tags
_DEPTH_HINT = "write one channel: uint16 or float32"
_AGAIN = "copy or download the dataset again"


class EmbeddedImages:
    """Images of a column `{bytes, path}`, read a few rows at a time; any order of access is possible.

    Args:
        path: the file.
        key: name of the column.
        rows: row of each frame (N,).
        size: width and height [px] of the images.
        units: units per metre of depth. If None, integers are millimetres and others metres.

    Raises:
        LogError: the file is damaged, or the column does not hold images.
    """

    def __init__(
        self, path: Path, key: str, rows: NDArray[np.int64], size: tuple[int, int], units: float | None = None
    ) -> None:
        self._path, self._key, self._rows = path, key, rows
        self._size, self._units = size, units
        self._file = open_parquet(path)
        kind = column_type(self._file, path, key)
        parts = [kind.field(n) for n in range(kind.num_fields)] if pa.types.is_struct(kind) else []
        check_type(path, key, kind, any(part.name == "bytes" and part.type in _BYTES for part in parts))
        metadata = self._file.metadata
        self._ends = np.cumsum([metadata.row_group(n).num_rows for n in range(metadata.num_row_groups)])
        self._group, self._start = -1, 0
        self._batch: list[bytes | None] = []
        self._batches: Iterator[Any] = iter(())

    def color(self, frame: int, source: Path) -> NDArray[np.uint8]:
        """Decode colour (H, W, 3) of a frame; ``source`` names it in errors.

        Raises:
            LogError: it is damaged or of another size.
        """
        return decode_color(self._checked(frame, source, "colour"), source)

    def depth(self, frame: int, source: Path) -> NDArray[np.float32]:
        """Decode depth (H, W) [m] of a frame; see :meth:`color`."""
        data = self._checked(frame, source, "depth")
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
        if image is None:
            raise LogError("is no image that can be decoded.", file=source, field="depth", hint=_AGAIN)
        if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
            problem = f"has {1 if image.ndim == 2 else image.shape[2]} channel(s) of {image.dtype}."
            raise LogError(problem, file=source, field="depth", hint=_DEPTH_HINT)
        units = self._units or (MILLIMETRES if image.dtype == np.uint16 else 1.0)
        return depth_in_metres((image / np.float32(units)).astype(np.float32), 1.0, source)

    def _checked(self, frame: int, source: Path, field: str) -> bytes:
        """Return the data of an image whose header announces the expected size."""
        try:
            data = self._data(int(self._rows[frame]))
        except (*DAMAGED, StopIteration) as error:
            self._group = -1
            raise LogError(f"cannot be read ({error}).", file=source, field=field, hint=_AGAIN) from error
        if data is None:
            raise LogError("is not embedded in the file.", file=source, field=field, hint="embed the images")
        found = image_size(data) or tiff_size(data)
        if found != self._size:
            seen = "is no PNG, JPEG or TIFF" if found is None else f"is {found[0]}x{found[1]}"
            expected = f"the intrinsics are for {self._size[0]}x{self._size[1]}"
            hint = "give the intrinsics of this image size"
            raise LogError(f"{seen}; {expected}.", file=source, field="image size", hint=hint)
        return data

    def _data(self, row: int) -> bytes | None:
        group = int(np.searchsorted(self._ends, row, side="right"))
        if group != self._group or row < self._start:
            self._batches = self._file.iter_batches(_BATCH, row_groups=[group], columns=[self._key])
            self._group, self._batch = group, []
            self._start = int(self._ends[group - 1]) if group else 0
        while row >= self._start + len(self._batch):
            self._start += len(self._batch)
            self._batch = next(self._batches).column(self._key).field("bytes").to_pylist()
        return self._batch[row - self._start]


def tiff_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height of a TIFF, read from its first directory; None for other data."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        return None
    found = {}
    try:
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, at)
        for entry in range(at + 2, at + 2 + 12 * count, 12):
            tag, kind = struct.unpack_from(f"{order}HH", data, entry)
            (found[tag],) = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, entry + 8)
    except struct.error:  # beyond the end of the data
        return None
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if {_TIFF_WIDTH, _TIFF_HEIGHT} <= found.keys() else None
