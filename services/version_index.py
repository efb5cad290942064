"""The index of saved versions: one SQLite file, whose transactions are on the disk once they end."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from urllib.parse import quote

from splatbot import failpoints
from splatbot.atomic import sync
from splatbot.errors import FormatError
from splatbot.services.problems import SaveError

SCHEMA = 1
_RESERVE_BYTES = 1 << 17  # of SQLite's shared memory and log during one transaction
_HINT = "restore it from a copy; or move its folder away, and the service begins without versions"
_TABLES = """
CREATE TABLE versions (
    map TEXT NOT NULL, number INTEGER NOT NULL, created REAL NOT NULL, label TEXT, note TEXT, owner TEXT NOT NULL,
    world TEXT NOT NULL, map_version INTEGER NOT NULL, gaussians INTEGER NOT NULL, keyframes INTEGER NOT NULL,
    bytes INTEGER NOT NULL, checksum TEXT NOT NULL, folder TEXT NOT NULL, parent INTEGER, restored_from INTEGER,
    PRIMARY KEY (map, number)
) STRICT;
CREATE TABLE numbers (map TEXT PRIMARY KEY, latest INTEGER NOT NULL) STRICT;
"""


@dataclass(frozen=True)
class Version:
    """A saved version of a map.

    Args:
        map: name of the map.
        number: of the version; numbers of deleted versions are not used again.
        created: Unix time [s].
        label: name that a client gave it; versions without one make room for later ones.
        note: text that a client gave it.
        owner: client whose quota it counts in.
        world: name of its world frame.
        map_version: of the state that it holds.
        gaussians: number of Gaussians.
        keyframes: number of keyframes; 0 if the mapper's state is not kept.
        bytes: size of its files.
        checksum: SHA-256 of the lists of checksums of its files.
        folder: of its files; versions of one state share it.
        parent: number of the version before it; None for the first.
        restored_from: number of the version that it repeats; None if it was saved.
    """

    map: str
    number: int
    created: float
    label: str | None
    note: str | None
    owner: str
    world: str
    map_version: int
    gaussians: int
    keyframes: int
    bytes: int
    checksum: str
    folder: str
    parent: int | None
    restored_from: int | None


_COLUMNS = ", ".join(field.name for field in fields(Version))
_PLACES = ", ".join("?" for _ in fields(Version))
_DELETE = "DELETE FROM versions WHERE map = ? AND number = ?"


class VersionIndex:
    """Rows of the index, which are read once and held in memory; any thread may read, and one at a time writes.

    Args:
        path: of the file.
        create: whether to create the file if it is missing or empty.

    Raises:
        FormatError: the file is damaged, of a later version of splatbot, or missing and not to be created.
        SaveError: it cannot be read or written.
    """

    def __init__(self, path: Path, *, create: bool = True) -> None:
        self._path = path
        self._reserve = path.with_name("reserve")
        self._lock = threading.Lock()
        if not create and not (path.is_file() and path.stat().st_size):
            raise FormatError("is missing or empty, and there are files of versions.", file=path, hint=_HINT)
        with self._connected(create=create) as db:
            db.execute("PRAGMA journal_mode=WAL")
            (found,) = db.execute("PRAGMA quick_check").fetchone()
            if found != "ok":
                raise FormatError(f"is damaged ({found}).", file=path, hint=_HINT)
            (schema,) = db.execute("PRAGMA user_version").fetchone()
            if schema > SCHEMA:
                hint = "start the splatbot that wrote it, or a later one"
                raise FormatError(f"has schema {schema}, this splatbot reads {SCHEMA}.", file=path, hint=hint)
            if schema == 0 and not create:
                raise FormatError("holds no index, and there are files of versions.", file=path, hint=_HINT)
            if schema == 0:
                db.executescript(f"BEGIN IMMEDIATE; {_TABLES} PRAGMA user_version={SCHEMA}; COMMIT;")
            self._versions = [Version(*row) for row in db.execute(f"SELECT {_COLUMNS} FROM versions ORDER BY rowid")]
            self._latest: dict[str, int] = dict(db.execute("SELECT map, latest FROM numbers").fetchall())

    def of_map(self, map_id: str) -> list[Version]:
        """Return the versions of a map by number."""
        return [version for version in self._versions if version.map == map_id]

    def every(self) -> list[Version]:
        """Return the versions of all maps, oldest first."""
        return list(self._versions)

    def next_number(self, map_id: str) -> int:
        """Return the number of the map's next version."""
        return 1 + self._latest.get(map_id, 0)

    def add(self, version: Version, *, instead_of: Sequence[Version] = ()) -> None:
        """Add a version and remove others, in one transaction."""
        with self._writing() as db:
            db.executemany(_DELETE, [(gone.map, gone.number) for gone in instead_of])
            db.execute(f"INSERT INTO versions ({_COLUMNS}) VALUES ({_PLACES})", astuple(version))
            db.execute("INSERT OR REPLACE INTO numbers VALUES (?, ?)", (version.map, version.number))
        self._latest[version.map] = version.number
        self._versions = [*(other for other in self._versions if other not in instead_of), version]

    def remove(self, version: Version) -> None:
        """Remove a version, also on a full disk."""
        with self._writing(in_reserve=True) as db:
            db.execute(_DELETE, (version.map, version.number))
        self._versions = [other for other in self._versions if other != version]

    def remove_map(self, map_id: str) -> None:
        """Remove all versions of a map, also on a full disk; the next one of that name has the number 1."""
        if map_id not in self._latest:
            return
        with self._writing(in_reserve=True) as db:
            db.execute("DELETE FROM versions WHERE map = ?", (map_id,))
            db.execute("DELETE FROM numbers WHERE map = ?", (map_id,))
        del self._latest[map_id]
        self._versions = [version for version in self._versions if version.map != map_id]

    def keep_reserve(self) -> None:
        """Keep space on the disk in which versions can be removed once it is full, if there is any."""
        try:
            if self._reserve.is_file() and self._reserve.stat().st_size == _RESERVE_BYTES:
                return
            with self._reserve.open("wb") as file:
                file.write(bytes(_RESERVE_BYTES))
                sync(file)
        except OSError:  # a part of it would hold space that versions need
            with suppress(OSError):
                self._reserve.unlink(missing_ok=True)

    @contextmanager
    def _connected(self, *, create: bool = False) -> Iterator[sqlite3.Connection]:
        """Open the file for one use: a file that stays open for writing prevents a remount of its disk.

        Raises:
            FormatError: the file is damaged.
            SaveError: the disk is full, read-only or gone.
        """
        address = f"file:{quote(str(self._path))}?mode={'rwc' if create else 'rw'}"
        try:
            with self._lock, closing(sqlite3.connect(address, uri=True, isolation_level=None)) as db:
                db.execute("PRAGMA synchronous=FULL")
                yield db
        except sqlite3.OperationalError as error:
            hint = "free some space, and check that the disk is mounted for writing"
            raise SaveError(f"the index of versions cannot be used ({error}).", file=self._path, hint=hint) from error
        except sqlite3.DatabaseError as error:
            raise FormatError(f"is damaged ({error}).", file=self._path, hint=_HINT) from error

    @contextmanager
    def _writing(self, *, in_reserve: bool = False) -> Iterator[sqlite3.Connection]:
        """Enter a transaction: all of it is on the disk at the end, or none of it after an error."""
        if in_reserve:
            with suppress(OSError):
                self._reserve.unlink(missing_ok=True)
        with self._connected() as db:  # closing it undoes an open transaction
            db.execute("BEGIN IMMEDIATE")
            yield db
            failpoints.reach("commit")
            db.execute("COMMIT")
            failpoints.reach("committed")
