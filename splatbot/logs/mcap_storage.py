"""MCAP storage with checksums, and the recovery of a recording whose process was killed."""

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
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x03, 0x04, 0x05, 0x06
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


class CheckedWriter(Writer):
    """Writer of bags with :class:`CheckedStorage`."""

    STORAGE_PLUGINS: ClassVar = {**Writer.STORAGE_PLUGINS, StoragePlugin.MCAP: CheckedStorage}  # type: ignore[misc]


def recover(partial: Path, path: Path) -> None:
    """Save the messages that a killed process left in ``partial``, and free that name.

    They become ``NAME.recovered-N.mcap`` next to ``path``. A folder that cannot be recovered is renamed, never deleted.

    Raises:
        LogError: another process records into it.
        OSError: the folder cannot be renamed.
    """
    if not partial.exists():
        return
    target = _free(path, "recovered")
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
