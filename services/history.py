"""The versions of served maps: saved between two frames, restored as the next state, opened as runs."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from splatbot.errors import InputError, MapNotFoundError, SplatbotError
from splatbot.gaussians import Snapshot
from splatbot.run.rollback import rolled_back
from splatbot.run.state import SavedRun
from splatbot.services.library import MapLibrary
from splatbot.services.live import LiveMapper, LiveMapping
from splatbot.services.problems import SaveError, disk_error
from splatbot.services.quotas import Quotas
from splatbot.services.scratch import Scratch
from splatbot.services.store import MapStore, ServedMap
from splatbot.services.version_files import read_version, save_slam
from splatbot.services.version_index import Version
from splatbot.services.versions import Versions, VersionsOffError, note_of_repeat
from splatbot.slam import Slam
from splatbot.trajectory import Trajectory

_log = logging.getLogger(__name__)
_PATIENCE_S = 30.0  # for the frame, or the final refinement, that the mapper works on


class OtherWorldError(InputError):
    """The version is of an earlier map of the same name."""

    http_status = 409


class NoKeyframesError(InputError):
    """The state of the map was saved, or is served, without keyframes."""

    http_status = 409


class MapHistory:
    """Saves, restores and opens versions of served maps.

    Args:
        store: the maps.
        library: saved maps; None if the service has no data folder.
        versions: saved versions; None if the service has no data folder.
        quotas: of clients.
        disk: held while a map is saved or deleted.
        mapping_of: returns the writer of a map by its generation; None if nothing maps it.
    """

    def __init__(
        self,
        store: MapStore,
        library: MapLibrary | None,
        versions: Versions | None,
        quotas: Quotas,
        disk: threading.Lock,
        mapping_of: Callable[[int], LiveMapping | None],
    ) -> None:
        self._store, self._library, self._versions, self._quotas = store, library, versions, quotas
        self._disk, self._mapping_of = disk, mapping_of

    @property
    def is_on(self) -> bool:
        """True if the service keeps versions."""
        return self._versions is not None

    @property
    def versions(self) -> Versions:
        """The saved versions.

        Raises:
            VersionsOffError: the service keeps none.
        """
        if self._versions is None:
            hint = "start it with --data FOLDER, or SPLATBOT_DATA_DIR"
            raise VersionsOffError("the service keeps no versions.", field="data_dir", hint=hint)
        return self._versions

    def save(self, served: ServedMap, *, owner: str, label: str | None = None, note: str | None = None) -> Version:
        """Save the present state of a map as a version; its mapper waits meanwhile.

        Raises:
            InputError: the map is a file.
            MapNotFoundError: it was deleted.
            MapNotReadyError: it has no state.
            QuotaError, VersionsFullError: there is no room.
            BusyError: the mapper works on one frame for too long.
            SaveError: the disk is full or gone.
        """
        _ = self.versions  # raises if the service keeps none
        if served.state == "static":
            raise InputError(
                f"map {served.id!r} is a file and keeps no versions.", field="map_id", hint="copy the file"
            )
        self._quotas.check_bytes(owner)
        with self._paused(served) as mapping:
            return self._save(served, _slam(mapping), owner=owner, label=label, note=note)

    def save_slam(self, served: ServedMap, slam: Slam, *, note: str) -> Version:
        """Save a map whose SLAM the caller owns, as a version of the map's owner.

        Raises:
            MapNotFoundError, QuotaError, VersionsFullError, SaveError: as for :meth:`save`.
        """
        return self._save(served, slam, owner=served.owner, note=note)

    def save_end(self, served: ServedMap, mapper: LiveMapper) -> None:
        """Save the state at the end of mapping, so that its keyframes remain; a failure is logged."""
        if self._versions is None or not isinstance(mapper, Slam) or not mapper.keyframes:
            return
        try:
            self.save_slam(served, mapper, note="end of mapping")
        except MapNotFoundError:
            _log.info("map %s was deleted", served.id)
        except SplatbotError as error:
            _log.error("map %s: the end of mapping is no version, so it cannot be merged: %s", served.id, error)

    def restore(self, served: ServedMap, number: int, *, owner: str) -> Version:
        """Let a map go back to a version, as its next state; the present state becomes a version first.

        A map that still grows goes on from the version: its next frame may be anywhere in it, and is lost otherwise.

        Returns:
            The new version that records it.

        Raises:
            VersionNotFoundError: no version has that number.
            OtherWorldError: it is of an earlier map of that name.
            NoKeyframesError: the map grows, and the version has no state of a mapper.
            DamagedVersionError: its files are missing or altered.
            MapNotFoundError, QuotaError, VersionsFullError, BusyError, SaveError: as for :meth:`save`.
        """
        version = self.versions.get(served.id, number)
        if version.world != served.world:
            hint = "merge or compare it with the map, which aligns both worlds"
            raise OtherWorldError(f"version {number} is of an earlier map of that name.", field="version", hint=hint)
        with self.versions.pinned(version) as folder, self._paused(served) as mapping:
            now = self._store.get(served.id, generation=served.generation)
            if self.versions.in_use(now) is None:
                self._save(now, _slam(mapping), owner=owner, note=f"before version {number} again")
            saved = read_version(version, folder)
            slam = None if mapping is None else self._slam_of(version, folder)
            with self._disk, ExitStack() as undo:
                now = self._store.get(served.id, generation=served.generation)
                map_version = 1 + now.map_version
                snapshot = Snapshot(saved["snapshot"].model, map_version, saved["snapshot"].stamp)
                path = saved["trajectory"]
                if path is None and now.trajectory is not None:  # without one, the store keeps the present one
                    path = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
                if mapping is not None and slam is not None:
                    undo.callback(slam.close)
                    map_version = 1 + max(now.map_version, mapping.mapper.snapshot().map_version)
                    rolled_back(slam, map_version)
                    snapshot, path = slam.snapshot(), slam.trajectory
                moved = slam if snapshot.map_version > map_version else None  # by a loop closure that was pending
                made = self._record(version, replace(now, snapshot=snapshot, trajectory=path), moved, owner=owner)
                self._store.publish(served.id, snapshot, path, generation=served.generation)
                if mapping is not None and slam is not None:
                    mapping.go_on_with(slam)
                undo.pop_all()
        self._keep(served)
        return made

    def delete(self, served: ServedMap, number: int) -> None:
        """Delete a version.

        Raises:
            VersionNotFoundError: no version has that number.
            VersionInUseError: the map answers from it, or a request works on it.
            SaveError: the disk is full or gone.
        """
        with self._disk:
            self.versions.delete(self.versions.get(served.id, number))

    @contextmanager
    def opened(self, served: ServedMap, version: Version | None) -> Iterator[Path]:
        """Enter with a folder that holds the mapper's state of a version, or of the map as it is now, as that of a run.

        Raises:
            NoKeyframesError: the state has no keyframes.
            DamagedVersionError: files of the version are missing or altered.
            BusyError: the mapper works on one frame for too long.
        """
        if version is None and served.run is not None:
            yield served.run.path
            return
        with ExitStack() as stack:
            if version is None:
                scratch = Scratch("export")
                stack.callback(scratch.discard)
                with self._paused(served) as mapping:
                    slam = _slam(mapping)
                    if slam is not None:
                        save_slam(slam, scratch.path, served.source)
                if slam is not None:
                    yield scratch.path
                    return
                version = self.versions.in_use(self._store.get(served.id, generation=served.generation))
            if version is None or not version.keyframes:
                hint = "map its recording again with --data, or name a version with keyframes"
                raise NoKeyframesError(f"map {served.id!r} has no keyframes in this state.", field="map", hint=hint)
            yield stack.enter_context(self.versions.pinned(version))

    @contextmanager
    def _paused(self, served: ServedMap) -> Iterator[LiveMapping | None]:
        """Enter between two frames of the mapping of a map; None if nothing maps it."""
        mapping = self._mapping_of(served.generation)
        if mapping is None:
            yield None
            return
        with mapping.paused(_PATIENCE_S) as goes_on:
            yield mapping if goes_on else None

    def _save(
        self, served: ServedMap, slam: Slam | None, *, owner: str, label: str | None = None, note: str | None = None
    ) -> Version:
        """Save the map, without which a restart would not find the version, and then the version."""
        with self._disk:
            now = self._store.get(served.id, generation=served.generation)
            if self._library is not None:
                self._library.save(now)
            check = partial(self._quotas.check_bytes, owner)
            return self.versions.save(now, slam, owner=owner, label=label, note=note, check=check)

    def _record(self, version: Version, now: ServedMap, moved: Slam | None, *, owner: str) -> Version:
        """Record the return to a version, with files of its own if the mapper has moved the map since it was loaded."""
        check = partial(self._quotas.check_bytes, owner)
        if moved is None:
            return self.versions.repeat(version, owner=owner, map_version=now.map_version, check=check)
        note = note_of_repeat(version)
        return self.versions.save(now, moved, owner=owner, note=note, check=check, restored_from=version)

    def _keep(self, served: ServedMap) -> None:
        """Save the map; a failure is counted, and the service tries again later."""
        try:
            with self._disk:
                if self._library is not None:
                    self._library.save(self._store.get(served.id, generation=served.generation))
        except (SaveError, MapNotFoundError) as error:
            _log.error("%s", error)

    def _slam_of(self, version: Version, folder: Path) -> Slam:
        """Load the mapper's state of a version from its checked files.

        Raises:
            NoKeyframesError: it has none.
        """
        if not version.keyframes:
            hint = "end the stream first, or restore a version with keyframes"
            raise NoKeyframesError(f"version {version.number} has no state to map from.", field="version", hint=hint)
        try:
            return SavedRun.load(folder).slam
        except OSError as error:
            raise disk_error(error) from error


def _slam(mapping: LiveMapping | None) -> Slam | None:
    """Return the SLAM of a mapping that is paused."""
    return mapping.mapper if mapping is not None and isinstance(mapping.mapper, Slam) else None
