"""MCAP storage with checksums, their check before a recording is read, and the recovery of a killed recording."""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
import struct
import time
from binascii import crc32
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, ClassVar

from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import (
    Channel,
    McapWriter,
    Schema,
    decompress,
    read_bytes,
    read_sized,
    read_string,
    write_channel,
    write_schema,
)

from splatbot.atomic import replace, sync
from splatbot.errors import LogError

FLUSH_S = 1.0  # [s] longest time that a message waits for the disk
_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_DATA_END_FORM, _FOOTER_FORM = struct.Struct("<BQI"), struct.Struct("<BQQQI")  # their last fields are checksums
_PART = 1 << 24  # bytes that are read at once
_CRC_AT = 33  # offset of the checksum in a chunk's record [bytes]

_log = logging.getLogger(__name__)


class CheckedStorage(McapWriter):
    """Storage whose chunks have checksums and reach the disk at least once a second while messages come.

    The file is locked while this process writes it.
    """

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        fcntl.flock(self.bio, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._flushed = time.monotonic()

    def close_chunk(self) -> None:
        """Write the pending chunk with its checksum, and flush it."""
        checksum, start = crc32(self.chunk.bio.getvalue()), self.bio.tell()
        super().close_chunk()
        end = self.bio.seek(0, os.SEEK_END)
        self.bio.seek(start + _CRC_AT)
        self.bio.write(struct.pack("<I", checksum))
        self.bio.seek(end)
        self.bio.flush()
        if time.monotonic() - self._flushed > FLUSH_S:
            self.sync()

    def flush_due(self) -> None:
        """Write the pending chunk if the last flush was more than a second ago."""
        if self.chunk.bio.tell() and time.monotonic() - self._flushed > FLUSH_S:
            self.close_chunk()

    def sync(self) -> None:
        """Flush the file to the disk."""
        sync(self.bio)
        self._flushed = time.monotonic()


def write_checksums(file: BinaryIO) -> None:
    """Write the checksums of the data and of the summary into a closed recording, which the writer leaves at 0.

    MCAP specification, records DataEnd and Footer.
    """
    end, summary = _find_summary(file)
    for at, checksum in (
        (summary - 4, _checksum(file, 0, summary - _DATA_END_FORM.size)),
        (end - 4, _checksum(file, summary, end - 4)),
    ):
        file.seek(at)
        file.write(struct.pack("<I", checksum))


def check_checksums(path: Path) -> None:
    """Check the checksums of the data and of the summary of a recording that has both.

    Raises:
        LogError: the file is damaged.
    """
    hint = "copy the recording again, or repair it (`mcap recover`)"
    with path.open("rb") as file:
        try:
            end, summary = _find_summary(file)
        except (ValueError, OSError, struct.error) as error:
            size = file.seek(0, os.SEEK_END)
            if _bytes_at(file, max(0, size - len(_MAGIC) - 4), 4) == bytes(4):
                return  # a recording without checksums
            raise LogError("is damaged: its footer is wrong.", file=path, field="log", hint=hint) from error
        known = [struct.unpack("<I", _bytes_at(file, at, 4))[0] for at in (summary - 4, end - 4)]
        if not any(known):
            return
        found = _checksum(file, 0, summary - _DATA_END_FORM.size), _checksum(file, summary, end - 4)
    for name, a, b in zip(("data", "summary"), known, found, strict=True):
        if a != b:
            raise LogError(f"is damaged: the checksum of its {name} differs.", file=path, field="log", hint=hint)


def _find_summary(file: BinaryIO) -> tuple[int, int]:
    """Return the offsets of the end of the footer and of the summary, which follows the end of the data.

    Raises:
        ValueError: there is no summary, or it is not where the footer says.
    """
    end = file.seek(0, os.SEEK_END) - len(_MAGIC)
    kind, _, summary, _, _ = _FOOTER_FORM.unpack(_bytes_at(file, end - _FOOTER_FORM.size, _FOOTER_FORM.size))
    data_end = _DATA_END_FORM.unpack(_bytes_at(file, summary - _DATA_END_FORM.size, _DATA_END_FORM.size))
    if kind != _FOOTER or data_end[:2] != (_DATA_END, 4):
        raise ValueError("no summary")
    return end, summary


def _bytes_at(file: BinaryIO, at: int, size: int) -> bytes:
    file.seek(at)
    return file.read(size)


def _checksum(file: BinaryIO, start: int, stop: int) -> int:
    """Return the CRC-32 of a range of a file."""
    file.seek(start)
    value = 0
    for at in range(start, stop, _PART):
        value = crc32(file.read(min(_PART, stop - at)), value)
    return value


class CheckedWriter(Writer):
    """Writer of bags with :class:`CheckedStorage`."""

    STORAGE_PLUGINS: ClassVar = {**Writer.STORAGE_PLUGINS, StoragePlugin.MCAP: CheckedStorage}  # type: ignore[misc]


def recover(partial: Path, path: Path, *, name: Path | None = None) -> None:
    """Save the messages that a killed process left in ``partial``, and free that name.

    They become the file ``name``, or ``NAME.recovered-N.mcap`` next to ``path``. A folder that cannot be recovered is
    renamed, never deleted.

    Raises:
        LogError: another process records into it.
        OSError: the folder cannot be renamed.
    """
    if not partial.exists():
        return
    target = name or _free(path, "recovered")
    try:
        count = _recover(partial, target)
    except (ReaderError, OSError, ValueError, KeyError, struct.error, EOFError) as error:
        aside = partial.with_name(f"{partial.name}-{time.time_ns()}")
        partial.rename(aside)
        _log.error("%s cannot be recovered (%s); it is kept as %s", partial, error, aside.name)
        return
    shutil.rmtree(partial, ignore_errors=True)
    if count:
        _log.warning("recovered %d messages of a recording that was cut off: %s", count, target)


def _free(path: Path, word: str) -> Path:
    number = 1
    while (target := path.with_name(f"{path.stem}.{word}-{number}{path.suffix}")).exists():
        number += 1
    return target


def _recover(partial: Path, target: Path) -> int:
    """Copy the whole chunks of a recording to ``target``; return the number of messages."""
    found = [made for made in partial.glob("*.mcap") if made.stem == partial.name]
    if not found:
        return 0
    folder = partial / "recovered"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    with found[0].open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            hint = "stop the other process, or choose another name"
            raise LogError("is being recorded by another process.", file=target, hint=hint) from error
        storage = CheckedStorage(folder, CompressionMode.STORAGE)
        for chunk in _chunks(file):
            _copy(chunk, storage)
        count = sum(storage.channel_stats.values())
        storage.close(9, "{}")
    if count:
        made = folder / f"{folder.name}.mcap"
        with made.open("r+b") as written:
            write_checksums(written)
            sync(written)
        replace(made, target)
    return count


def _chunks(file: BinaryIO) -> Iterator[bytes]:
    """Yield the content of each chunk up to the first that is cut off or damaged."""
    if file.read(len(_MAGIC)) != _MAGIC:
        return
    while operation := file.read(1):
        try:
            record = BytesIO(read_sized(file))
            if operation[0] != _CHUNK:
                continue
            _, _, size, checksum = struct.unpack("<QQQI", record.read(28))
            compression, (length,) = read_string(record), struct.unpack("<Q", record.read(8))
            content = decompress(record.read(length), compression, size, checksum)
        except Exception as error:  # each decompressor has its own errors
            _log.warning("%s is cut off or damaged at byte %d (%s)", file.name, file.tell(), error)
            return
        yield content


def _copy(chunk: bytes, storage: Any) -> None:
    """Add the records of a chunk to a storage."""
    records = BytesIO(chunk)
    while operation := records.read(1):
        record = BytesIO(read_sized(records))
        if operation[0] == _SCHEMA:
            number = struct.unpack("<H", record.read(2))[0]
            storage.schemas.append(Schema(number, read_string(record), read_string(record), read_string(record)))
            write_schema(storage.chunk.bio, storage.schemas[-1])
        elif operation[0] == _CHANNEL:
            number, schema = struct.unpack("<HH", record.read(4))
            name = next(known.name for known in storage.schemas if known.id == schema)
            channel = Channel(number, name, read_string(record), read_string(record), read_bytes(record))
            storage.channels.append(channel)
            storage.channel_stats[number] = 0
            write_channel(storage.chunk.bio, channel, storage.schemas)
        elif operation[0] == _MESSAGE:
            number, _, stamp, _ = struct.unpack("<HIQQ", record.read(22))
            storage.write(SimpleNamespace(id=number), stamp, record.read())
