"""Maps on disk: a saved version is complete or absent, and a restart serves the latest complete one."""

from __future__ import annotations

import json
import logging
import re
import secrets
import shutil
from pathlib import Path
from typing import Any

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError, InputError, SplatbotError
from splatbot.formats.ply import load_ply, save_ply
from splatbot.gaussians import Snapshot
from splatbot.services.store import MapStore, ServedMap
from splatbot.trajectory import Trajectory
from splatbot.workspace import NAME as WORKSPACE
from splatbot.workspace import find_workspace

_log = logging.getLogger(__name__)

_ID = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def check_id(map_id: str) -> str:
    """Return ``map_id`` if it is a valid name of a map and of a folder.

    Raises:
        InputError: it may not.
    """
    if not _ID.fullmatch(map_id):
        raise InputError(f"is {map_id[:80]!r}.", field="id", hint="1 to 64 of a-z, 0-9, - and _, no - or _ first")
    return map_id


class SaveError(SplatbotError):
    """A map cannot be written to disk; the state saved before is still there."""

    http_status = 507


class MapLibrary:
    """A folder with a folder for each map, in which ``current`` names the state in force.

    A state's folder is first written under another name. ``current`` is replaced last, so that a
    process killed in between leaves the earlier state in force.

    Args:
        folder: made if need be.

    Raises:
        InputError: the folder cannot be made.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            hint = "name a folder that can be written to"
            raise InputError(f"cannot be made ({error.strerror}).", file=folder, field="data_dir", hint=hint) from error

    def save(self, served: ServedMap) -> None:
        """Keep the map's present state; nothing is done for a map without one, or for a state that is kept already.

        Raises:
            SaveError: it cannot be written, as when the disk is full.
        """
        if served.snapshot is None or self._current(served.id) == f"v{served.map_version}":
            return
        home = self.folder / check_id(served.id)
        draft = home / f".{secrets.token_hex(4)}.tmp"
        try:
            draft.mkdir(parents=True)
            self._write(served, served.snapshot, draft)
            state = home / f"v{served.map_version}"
            shutil.rmtree(state, ignore_errors=True)  # of another life of a map of this name
            draft.rename(state)
            with atomic_write(home / "current") as file:
                file.write(state.name.encode())
        except OSError as error:
            hint = "free some space, or point SPLATBOT_DATA_DIR elsewhere"
            raise SaveError(f"map {served.id!r} cannot be saved ({error.strerror}).", hint=hint) from error
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        self._sweep(home, keep=state.name)

    def remove(self, map_id: str) -> None:
        """Forget a map; one that was never saved is no error."""
        home = self.folder / check_id(map_id)
        (home / "current").unlink(missing_ok=True)  # first: from here on the map is deleted
        shutil.rmtree(home, ignore_errors=True)

    def load_all(self, store: MapStore) -> list[str]:
        """Serve the saved maps and return their ids; unreadable ones are skipped and logged."""
        loaded = []
        for home in sorted(self.folder.iterdir()):
            name = self._current(home.name) if _ID.fullmatch(home.name) else None
            if name is None:
                continue
            try:
                self._load(store, home.name, home / name)
                loaded.append(home.name)
            except SplatbotError as error:
                _log.error("map %s is left out: %s", home.name, error)
            self._sweep(home, keep=name)
        return loaded

    def _write(self, served: ServedMap, snapshot: Snapshot, folder: Path) -> None:
        save_ply(snapshot.model, folder / "map.ply", bookkeeping=True)
        if served.trajectory is not None and len(served.trajectory.stamps):
            served.trajectory.save(folder / "trajectory.tum")
        if served.workspace is not None:
            served.workspace.save(folder / WORKSPACE)
        saved = {"source": served.source, "map_version": snapshot.map_version, "stamp": snapshot.stamp}
        (folder / "map.json").write_text(json.dumps(saved))

    def _load(self, store: MapStore, map_id: str, folder: Path) -> None:
        saved = _read_json(folder / "map.json")
        path = folder / "trajectory.tum"
        store.add(
            map_id,
            source=str(saved["source"]),
            state="ended",
            snapshot=Snapshot(load_ply(folder / "map.ply"), int(saved["map_version"]), float(saved["stamp"])),
            trajectory=Trajectory.load(path) if path.is_file() else None,
            workspace=find_workspace(folder),
        )

    def _current(self, map_id: str) -> str | None:
        """Return the folder of the version in force."""
        try:
            name = (self.folder / map_id / "current").read_text()
        except (OSError, UnicodeDecodeError):
            return None
        return name if re.fullmatch(r"v\d+", name) else None

    @staticmethod
    def _sweep(home: Path, *, keep: str) -> None:
        """Remove older versions and the remains of a killed process."""
        for old in home.iterdir():
            if old.is_dir() and old.name != keep:
                shutil.rmtree(old, ignore_errors=True)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        saved: dict[str, Any] = json.loads(path.read_text())
        return {"source": saved["source"], "map_version": saved["map_version"], "stamp": saved["stamp"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"is damaged ({error}).", file=path, hint="delete the map's folder") from error
