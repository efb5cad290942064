"""Maps on disk: a saved state is whole or not there, and a restart serves the newest whole one."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import logging
import os
import re
import secrets
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splatbot.atomic import atomic_write, replace, sweep_drafts, sync_folder
from splatbot.checksums import NAME as SUMS
from splatbot.checksums import check_folder, write_sums
from splatbot.errors import FormatError, InputError, SplatbotError
from splatbot.formats.ply import load_ply, save_ply
from splatbot.gaussians import Snapshot
from splatbot.services.problems import SaveError
from splatbot.services.store import MapStore, ServedMap
from splatbot.trajectory import Trajectory
from splatbot.workspace import NAME as WORKSPACE
from splatbot.workspace import find_workspace

_log = logging.getLogger(__name__)

_LOCK = ".lock"
_CURRENT = "current"
_DELETED = ".deleted-"
_HINT = "the state before it is served; the folder is kept for inspection"
_ID = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def check_id(map_id: str) -> str:
    """Return ``map_id`` if it is a valid name of a map and of a folder.

    Raises:
        InputError: it may not.
    """
    if not _ID.fullmatch(map_id):
        raise InputError(f"is {map_id[:80]!r}.", field="id", hint="1 to 64 of a-z, 0-9, - and _, no - or _ first")
    return map_id


class MapLibrary:
    """A folder with a folder for each map, which holds the two latest saved states as folders ``vN``.

    A state's folder is written under another name, flushed and renamed, with the checksums of its files. The
    newest whole state is in force; ``current`` names it for people. Files that are damaged are set aside as
    ``vN.damaged``.

    Args:
        folder: made if need be.

    Raises:
        InputError: the folder cannot be made.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.failing: dict[str, str] = {}
        self.failures = 0
        self._kept: dict[str, tuple[int, int]] = {}
        self._lock_file: int | None = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            hint = "name a folder that can be written to"
            raise InputError(f"cannot be made ({error.strerror}).", file=folder, field="data_dir", hint=hint) from error

    def lock(self) -> None:
        """Reserve the folder for this process until :meth:`unlock`.

        Raises:
            InputError: another process has it, or it cannot be written to.
        """
        path = self.folder / _LOCK
        try:
            path.touch()
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)  # an open writer would prevent a remount
        except OSError as error:
            hint = "name a folder that can be written to"
            raise InputError(f"cannot be locked ({error.strerror}).", file=path, field="data_dir", hint=hint) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.write_text(f"{os.getpid()}\n")
        except OSError as error:
            holder = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip()
            os.close(descriptor)
            busy = isinstance(error, BlockingIOError)
            why = f"is in use by process {holder or '?'}." if busy else f"cannot be locked ({error.strerror})."
            hint = "stop that service, or name another folder" if busy else "name a folder that can be written to"
            raise InputError(why, file=self.folder, field="data_dir", hint=hint) from error
        self._lock_file = descriptor

    def unlock(self) -> None:
        """Release the folder."""
        if self._lock_file is not None:
            os.close(self._lock_file)
            self._lock_file = None

    def save(self, served: ServedMap) -> None:
        """Keep the map's present state; nothing is done for a map without one, or for a state that is kept already.

        Raises:
            SaveError: it cannot be written, as when the disk is full.
        """
        if served.snapshot is None or self._kept.get(served.id) == (served.generation, served.map_version):
            return
        home = self.folder / check_id(served.id)
        draft = home / f".{secrets.token_hex(4)}.tmp"
        state = home / f"v{served.map_version}"
        try:
            self._check_lock()
            home.mkdir(exist_ok=True)
            if self._kept.get(served.id, (0, 0))[0] != served.generation:
                for earlier in _states(home):  # of another life of the name, which could not be read
                    _set_aside(earlier)
            draft.mkdir()
            write_map(served, served.snapshot, draft)
            if state.exists():  # an earlier save of this version ended before it was named
                shutil.rmtree(state)
            replace(draft, state)
            with atomic_write(home / _CURRENT) as file:
                file.write(state.name.encode())
            sync_folder(self.folder)
        except OSError as error:
            self.failures += 1
            self.failing[served.id] = error.strerror or str(error)
            hint = "free some space, check the disk, or point SPLATBOT_DATA_DIR elsewhere"
            raise SaveError(f"map {served.id!r} cannot be saved ({self.failing[served.id]}).", hint=hint) from error
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        self.failing.pop(served.id, None)
        self._kept[served.id] = served.generation, served.map_version
        try:
            _sweep(home, keep=[path.name for path in _states(home)[:2]])
        except OSError as error:  # the state is saved; a disk that vanished is the next save's failure
            _log.warning("map %s: older states cannot be removed: %s", served.id, error)

    def remove(self, map_id: str) -> None:
        """Forget a map; one that was never saved is no error.

        Raises:
            SaveError: it cannot be deleted.
        """
        grave = self.folder / f"{_DELETED}{secrets.token_hex(4)}"
        home = self.folder / check_id(map_id)
        try:
            self._check_lock()
            if home.exists():
                replace(home, grave)  # from here on the map is deleted
        except OSError as error:
            hint = "check that the disk is mounted for writing"
            raise SaveError(f"map {map_id!r} cannot be deleted ({error.strerror}).", hint=hint) from error
        shutil.rmtree(grave, ignore_errors=True)
        self.failing.pop(map_id, None)
        self._kept.pop(map_id, None)

    def load_all(self, store: MapStore) -> list[str]:
        """Serve the saved maps and return their ids; damaged states are set aside and logged."""
        loaded = []
        for home in sorted(self.folder.iterdir()):
            if home.name.startswith(_DELETED):
                shutil.rmtree(home, ignore_errors=True)
            if not _ID.fullmatch(home.name) or not home.is_dir():
                continue
            try:
                if self._load(store, home):
                    loaded.append(home.name)
            except (SplatbotError, OSError) as error:
                _log.error("map %s is left out: %s", home.name, error)
        return loaded

    def _load(self, store: MapStore, home: Path) -> bool:
        """Serve the newest whole state of a map; return whether there is one."""
        named = _current(home)
        states = [path for path in _states(home) if path.name == named or (path / SUMS).exists()]
        for state in states:
            try:
                saved = _read(state)
            except InputError as error:
                _log.error("map %s: %s is damaged and set aside: %s", home.name, state.name, error)
                _set_aside(state)
                continue
            served = store.add(home.name, state="ended", counted=False, **saved)
            self._kept[home.name] = served.generation, served.map_version
            if named != state.name:
                _log.error("map %s: %s names %s, %s is served", home.name, _CURRENT, named, state.name)
                with atomic_write(home / _CURRENT) as file:
                    file.write(state.name.encode())
            _sweep(home, keep=[path.name for path in states])
            return True
        if states or named is not None:
            _log.error("map %s is left out: no state of it is whole", home.name)
        _sweep(home, keep=[])
        return False

    def _check_lock(self) -> None:
        """Check that the locked folder is still there.

        Raises:
            OSError: it is not, as after unmounting its disk.
        """
        if self._lock_file is None:
            return
        try:
            same = os.path.samestat((self.folder / _LOCK).stat(), os.fstat(self._lock_file))
        except FileNotFoundError:
            same = False
        if not same:
            raise OSError(errno.ESTALE, "the folder was unmounted or replaced")


def _states(home: Path) -> list[Path]:
    """Return the folders of a map's states, newest first."""
    found = [path for path in home.iterdir() if re.fullmatch(r"v\d+", path.name) and path.is_dir()]
    return sorted(found, key=lambda path: int(path.name[1:]), reverse=True)


def _current(home: Path) -> str | None:
    """Return the text of ``current``, or None if the file is missing."""
    try:
        return (home / _CURRENT).read_text(errors="replace")
    except FileNotFoundError:
        return None


def write_map(served: ServedMap, snapshot: Snapshot, folder: Path) -> None:
    """Write a state of a map into an empty folder, with checksums of its files."""
    save_ply(snapshot.model, folder / "map.ply", bookkeeping=True)
    if served.trajectory is not None and len(served.trajectory.stamps):
        served.trajectory.save(folder / "trajectory.tum")
    if served.workspace is not None:
        served.workspace.save(folder / WORKSPACE)
    saved = {
        "format": 2,
        "source": served.source,
        "map_version": snapshot.map_version,
        "stamp": snapshot.stamp,
        "world": served.world,
        "owner": served.owner,
    }
    with atomic_write(folder / "map.json") as file:
        file.write(json.dumps(saved).encode())
    write_sums(folder, [path.name for path in folder.iterdir()])


def _read(folder: Path) -> dict[str, Any]:
    """Read a state as arguments of :meth:`MapStore.add`.

    Raises:
        InputError: a file is damaged, or belongs to another folder.
    """
    found = read_map(folder)
    if folder.name != f"v{found['snapshot'].map_version}":
        raise FormatError("belongs to another folder.", file=folder / "map.json", hint=_HINT)
    return {"world": _world_of_old(folder), **found}


def _world_of_old(folder: Path) -> str:
    """Return the name of the world of a state that was saved without one, the same at each start."""
    content = (folder / "map.json").read_bytes()
    return hashlib.sha256(f"{folder.parent.name}\n".encode() + content).hexdigest()[:16]


def read_map(folder: Path) -> dict[str, Any]:
    """Read a folder of :func:`write_map` as arguments of :meth:`MapStore.add`.

    Raises:
        InputError: a file is damaged.
    """
    listed = check_folder(folder)
    path = folder / "map.json"
    try:
        saved = json.loads(path.read_text())
        source, version, stamp = str(saved["source"]), int(saved["map_version"]), float(saved["stamp"])
        more = {name: str(saved[name]) for name in ("world", "owner") if name in saved}
        whole = listed or saved.get("format", 1) == 1
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"is damaged ({error}).", file=path, hint=_HINT) from error
    if not whole:
        raise FormatError(f"is saved with checksums, and there is no {SUMS}.", file=path, hint=_HINT)
    if not listed:
        _log.warning("%s has no checksums: an earlier version saved it", folder)
    trajectory = folder / "trajectory.tum"
    return {
        "source": source,
        "snapshot": Snapshot(load_ply(folder / "map.ply"), version, stamp),
        "trajectory": Trajectory.load(trajectory) if trajectory.is_file() else None,
        "workspace": find_workspace(folder),
        **more,
    }


def _set_aside(state: Path) -> None:
    """Rename a state that cannot be served, for inspection; an earlier one of that name is replaced."""
    aside = state.with_name(f"{state.name}.damaged")
    shutil.rmtree(aside, ignore_errors=True)
    replace(state, aside)


def _sweep(home: Path, *, keep: Sequence[str]) -> None:
    """Remove older states and the remains of a killed process."""
    sweep_drafts(home)
    for old in home.iterdir():
        if old.is_dir() and old.name not in keep and not old.name.endswith(".damaged"):
            shutil.rmtree(old, ignore_errors=True)
