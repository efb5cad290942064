"""Versions of maps on disk: saved states to which a map can go back, and which can be merged and compared."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from splatbot.errors import InputError, SplatbotError
from splatbot.services.problems import disk_error
from splatbot.services.store import ServedMap
from splatbot.services.version_files import SavedFiles, VersionFiles
from splatbot.services.version_index import Version, VersionIndex
from splatbot.slam import Slam

_log = logging.getLogger(__name__)

FOLDER = ".versions"
"""Name in the data folder; no map has a name with a dot."""


def _any_size(_size: int) -> None:
    """Accept every size."""


class VersionNotFoundError(InputError):
    """No version of that number."""

    http_status = 404


class VersionInUseError(InputError):
    """The map answers from the version, or a request works on it."""

    http_status = 409


class VersionsFullError(InputError):
    """There is no room for another version."""

    http_status = 409


class VersionsOffError(InputError):
    """The service has no folder for versions."""

    http_status = 409


class Versions:
    """Versions of all maps: immutable files below ``files``, and the index ``index.sqlite``.

    The files of a version are complete and on the disk before the index names them. A deleted version leaves the index
    before its files go. So a process that is killed leaves at most files that no version names. The next start removes
    drafts, and sets whole folders aside as ``NAME.unnamed``. The process must own the folder.

    Args:
        folder: created if it does not exist.
        most: versions of one map.
        most_bytes: size of all versions [bytes].
        served: returns the present state of a map; None if there is no such map.

    Raises:
        FormatError: the index is damaged, or missing while there are files of versions.
        SaveError: the folder cannot be written to.
    """

    def __init__(self, folder: Path, *, most: int, most_bytes: int, served: Callable[[str], ServedMap | None]) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._served = served
        self._lock = threading.RLock()  # of the index with the pins: a version that is pinned stays
        self._pins: Counter[str] = Counter()  # of folders
        try:
            self.files = VersionFiles(folder / "files")
            self._index = VersionIndex(folder / "index.sqlite", create=self.files.is_empty)
            self.files.sweep({version.folder for version in self._index.every()})
        except OSError as error:
            raise disk_error(error) from error
        self._index.keep_reserve()

    def of_map(self, map_id: str) -> list[Version]:
        """Return the versions of a map by number."""
        return self._index.of_map(map_id)

    def get(self, map_id: str, number: int) -> Version:
        """Return a version.

        Raises:
            VersionNotFoundError: no version has that number.
        """
        found = next((version for version in self.of_map(map_id) if version.number == number), None)
        if found is None:
            hint = f"GET /v1/maps/{map_id}/versions lists them"
            raise VersionNotFoundError(f"map {map_id!r} has no version {number}.", field="version", hint=hint)
        return found

    def in_use(self, served: ServedMap) -> Version | None:
        """Return the newest version that holds the present state of a map; None if that state is not saved."""
        return next((v for v in reversed(self.of_map(served.id)) if _holds(v, served)), None)

    def bytes_of(self, owner: str) -> int:
        """Return the size of the versions of a client [bytes]."""
        return _total([version for version in self._index.every() if version.owner == owner])

    def save(
        self,
        served: ServedMap,
        slam: Slam | None,
        *,
        owner: str,
        label: str | None = None,
        note: str | None = None,
        check: Callable[[int], None] = _any_size,
        restored_from: Version | None = None,
    ) -> Version:
        """Save the present state of a map as a new version.

        Args:
            served: the map. If its state is saved already and nothing maps it, the new version shares the files.
            slam: its mapper between two frames. If None, nothing maps it.
            owner: client whose quota the version counts in.
            label, note: texts of the client.
            check: called with the size [bytes] of files that are new to the owner, before the version is there; its
                errors prevent the version.
            restored_from: version of which the state is made, if any.

        Raises:
            MapNotReadyError: the map has no state.
            VersionsFullError: there is no room, because the other versions have labels or are in use.
            SaveError: it cannot be written.
        """
        created, gaussians = time.time(), len(served.ready.model)
        earlier = [v for v in self.of_map(served.id) if v.world == served.world and v.map_version <= served.map_version]
        parent = restored_from or (earlier[-1] if earlier else None)
        known = self.in_use(served) if slam is None else None
        files = self.files.write(served, slam) if known is None else SavedFiles.of(known)
        version = Version(
            map=served.id,
            number=0,
            created=created,
            label=label,
            note=note,
            owner=owner,
            world=served.world,
            map_version=served.map_version,
            gaussians=gaussians,
            keyframes=files.keyframes,
            bytes=files.bytes,
            checksum=files.checksum,
            folder=files.folder,
            parent=None if parent is None else parent.number,
            restored_from=None if restored_from is None else restored_from.number,
        )
        try:
            return self._add(version, check)
        except SplatbotError:
            self._remove_files(files.folder)
            raise

    def repeat(
        self, version: Version, *, owner: str, map_version: int, check: Callable[[int], None] = _any_size
    ) -> Version:
        """Record that a map went back to a version: a new version that shares its files.

        Args:
            version: the version.
            owner: client whose quota the new version counts in.
            map_version: of the restored state.
            check: as for :meth:`save`.

        Raises:
            VersionsFullError: there is no room for another version.
            SaveError: the index cannot be written.
        """
        repeated = replace(
            version,
            created=time.time(),
            label=None,
            note=note_of_repeat(version),
            owner=owner,
            map_version=map_version,
            parent=version.number,
            restored_from=version.number,
        )
        return self._add(repeated, check)

    def delete(self, version: Version) -> None:
        """Delete a version.

        Raises:
            VersionInUseError: the map answers from it, or a request works on it.
            SaveError: the index cannot be written.
        """
        with self._lock:
            if self._pins[version.folder]:
                hint = "wait for the merge, comparison or restoration"
                raise VersionInUseError(f"a request works on version {version.number}.", field="version", hint=hint)
            if self._is_in_use(version):
                hint = "restore another version first, or delete the map"
                raise VersionInUseError(f"the map answers from version {version.number}.", field="version", hint=hint)
            self._index.remove(version)
            self._remove_files(version.folder)
            self._index.keep_reserve()

    def remove_map(self, map_id: str) -> None:
        """Remove all versions of a map; files that a request reads go when it ends.

        Raises:
            SaveError: the index cannot be written.
        """
        with self._lock:
            gone = self.of_map(map_id)
            self._index.remove_map(map_id)
            for version in gone:
                self._remove_files(version.folder)
            self._index.keep_reserve()

    @contextmanager
    def pinned(self, version: Version) -> Iterator[Path]:
        """Enter with the checked files of a version, which stay until the end.

        Yields:
            Folder whose ``state`` holds the mapper's state, as that of a run.

        Raises:
            VersionNotFoundError: the version was deleted.
            DamagedVersionError: files are missing or altered.
        """
        with self._lock:
            if self.get(version.map, version.number) != version:  # another map took the name
                raise VersionNotFoundError(f"version {version.number} was deleted.", field="version")
            self._pins[version.folder] += 1
        try:
            yield self.files.checked(version)
        finally:
            with self._lock:
                self._pins[version.folder] -= 1
                self._remove_files(version.folder)

    def _add(self, version: Version, check: Callable[[int], None]) -> Version:
        """Add a version whose files are there, under the next number, in place of those that make room for it."""
        with self._lock:
            every = self._index.every()
            if all((other.owner, other.folder) != (version.owner, version.folder) for other in every):
                check(version.bytes)
            gone = self._making_room(version)
            version = replace(version, number=self._index.next_number(version.map))
            self._index.add(version, instead_of=gone)
            for other in gone:
                _log.info("version %d of map %s makes room", other.number, other.map)
                self._remove_files(other.folder)
            self._index.keep_reserve()
        return version

    def _making_room(self, version: Version) -> list[Version]:
        """Choose the oldest versions without a label whose removal lets a version fit, and remove none.

        Those of the same map make room for its number, and those of the same client for its bytes. Files that other
        versions share make no room.

        Raises:
            VersionsFullError: the others have labels or are in use.
        """
        every = self._index.every()
        free = [v for v in every if v.label is None and not self._pins[v.folder] and not self._is_in_use(v)]
        own, of_map = self.of_map(version.map), [v for v in free if v.map == version.map]
        surplus = max(0, len(own) + 1 - self._most)
        gone = of_map[:surplus]
        if len(gone) < surplus:
            raise _full(f"map {version.map!r} has {len(own)} versions already.", "SPLATBOT_MAX_VERSIONS")
        kept = [v for v in every if v not in gone]
        removable = [v for v in free if v in kept and v.owner == version.owner]
        for folder in dict.fromkeys(v.folder for v in removable):
            if _total([*kept, version]) <= self._most_bytes:
                break
            sharing = [v for v in kept if v.folder == folder]
            if folder != version.folder and all(v in removable for v in sharing):
                gone += sharing
                kept = [v for v in kept if v not in sharing]
        if _total([*kept, version]) > self._most_bytes:
            why = f"the versions have {_total(every)} bytes already, and this one has {version.bytes}."
            raise _full(why, "SPLATBOT_MAX_VERSIONS_BYTES")
        return gone

    def _is_in_use(self, version: Version) -> bool:
        served = self._served(version.map)
        return served is not None and self.in_use(served) == version

    def _remove_files(self, name: str) -> None:
        """Remove files that no version names any more, and no request reads."""
        if not self._pins[name] and all(version.folder != name for version in self._index.every()):
            self.files.remove(name)


def note_of_repeat(version: Version) -> str:
    """Return the note of a version that records the return to another one."""
    return f"version {version.number} again"


def _full(why: str, setting: str) -> VersionsFullError:
    return VersionsFullError(why, field="versions", hint=f"delete a version, or raise {setting}")


def _holds(version: Version, served: ServedMap) -> bool:
    return (version.world, version.map_version) == (served.world, served.map_version)


def _total(versions: list[Version]) -> int:
    """Return the size of versions [bytes]; files that several share count once."""
    return sum({version.folder: version.bytes for version in versions}.values())
