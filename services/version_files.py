"""The files of saved versions: written as a draft, named once they are whole, and checked at each use."""

from __future__ import annotations

import hashlib
import logging
import re
import secrets
import shutil
from collections.abc import Set
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from splatbot.atomic import replace, sync_folder
from splatbot.checksums import NAME as SUMS
from splatbot.checksums import check_folder, write_sums
from splatbot.errors import FormatError, InputError, SplatbotError
from splatbot.run.state import Checkpoint
from splatbot.run.state.checkpoint import FOLDER as STATE
from splatbot.run.state.checkpoint import LogPlace
from splatbot.services.library import read_map, write_map
from splatbot.services.problems import disk_error
from splatbot.services.store import ServedMap
from splatbot.services.version_index import Version
from splatbot.slam import Slam

_log = logging.getLogger(__name__)

_MAP = "map"  # next to the folder `state` of the mapper
_WHOLE = re.compile(r"[0-9a-f]{16}")
_DRAFT = ".draft"
_UNNAMED = ".unnamed"


class DamagedVersionError(SplatbotError):
    """Files of a version are missing or altered."""


@dataclass(frozen=True)
class SavedFiles:
    """The files of one state of a map.

    Args:
        folder, keyframes, bytes, checksum: as of :class:`~splatbot.services.version_index.Version`.
    """

    folder: str
    keyframes: int
    bytes: int
    checksum: str

    @classmethod
    def of(cls, version: Version) -> Self:
        """Return the files of a version."""
        return cls(version.folder, version.keyframes, version.bytes, version.checksum)


class VersionFiles:
    """The folders of all versions: ``NAME`` is whole, ``NAME.draft`` is not, ``NAME.unnamed`` is set aside.

    Args:
        folder: of these folders; created if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def is_empty(self) -> bool:
        """True if there are no files of a version."""
        return not any(_WHOLE.fullmatch(path.name) for path in self.folder.iterdir())

    def write(self, served: ServedMap, slam: Slam | None) -> SavedFiles:
        """Write the present state of a map, and of its mapper if there is one, into a new folder.

        Raises:
            MapNotReadyError: the map has no state.
            SaveError: it cannot be written.
        """
        name, snapshot = secrets.token_hex(8), served.ready
        draft = self.folder / f"{name}{_DRAFT}"
        try:
            (draft / _MAP).mkdir(parents=True)
            write_map(served, snapshot, draft / _MAP)
            if slam is not None:
                save_slam(slam, draft, served.source)
            keyframes = 0 if slam is None else len(slam.keyframes)  # none is on its way after the save
            written = SavedFiles(name, keyframes, _size_of(draft), _checksum(draft))
            sync_folder(draft)
            replace(draft, self.folder / name)
        except OSError as error:
            raise disk_error(error) from error
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        return written

    def checked(self, version: Version) -> Path:
        """Return the folder of a version after a check of all its files.

        Raises:
            DamagedVersionError: one is missing or altered.
        """
        folder = self.folder / version.folder
        try:
            if _checksum(folder) != version.checksum:
                raise FormatError("is damaged: its checksum is not that of the index.", file=folder)
            for part in sorted(folder.iterdir()):
                check_folder(part)
        except (InputError, OSError) as error:
            raise _damaged(version, error) from error
        return folder

    def remove(self, name: str) -> None:
        """Remove a folder, if it exists; after a kill it is whole, or a draft that :meth:`sweep` removes."""
        draft = self.folder / f"{name}{_DRAFT}"
        with suppress(OSError):
            (self.folder / name).rename(draft)
        shutil.rmtree(draft, ignore_errors=True)

    def sweep(self, named: Set[str]) -> None:
        """Remove the drafts of a killed process, and set whole folders aside that are not among the named ones."""
        for path in self.folder.iterdir():
            if path.name.endswith(_DRAFT):
                shutil.rmtree(path, ignore_errors=True)
            elif path.name not in named and _WHOLE.fullmatch(path.name):
                _log.error("%s is named by no version and set aside", path)
                replace(path, path.with_name(f"{path.name}{_UNNAMED}"))


def read_version(version: Version, folder: Path) -> dict[str, Any]:
    """Read the map of a version from its checked files, as arguments of :meth:`MapStore.add`.

    Raises:
        DamagedVersionError: a file is damaged.
    """
    try:
        return read_map(folder / _MAP)
    except InputError as error:
        raise _damaged(version, error) from error


def save_slam(slam: Slam, folder: Path, source: str) -> None:
    """Save the state of a mapper between two frames into ``folder/state``, with checksums."""
    frames = len(slam.results)
    Checkpoint(folder, 0.0).save(slam, {}, LogPlace(source, "", frames, None, frames), slam.config)
    write_sums(folder / STATE, [path.name for path in (folder / STATE).iterdir()])


def _damaged(version: Version, error: Exception) -> DamagedVersionError:
    _log.error("version %d of map %s is damaged: %s", version.number, version.map, error)
    hint = "delete it, and use another version; the service's log names the file"
    return DamagedVersionError(f"version {version.number} of map {version.map!r} is damaged.", hint=hint)


def _checksum(folder: Path) -> str:
    """Return the SHA-256 of the lists of checksums of a version's folders."""
    digest = hashlib.sha256()
    for part in sorted(path.name for path in folder.iterdir()):
        digest.update(f"{part}\n".encode() + (folder / part / SUMS).read_bytes())
    return digest.hexdigest()


def _size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
