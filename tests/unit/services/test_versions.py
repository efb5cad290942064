"""Saved versions of maps: whole or absent after a crash, checked at each use, bounded, safe from other threads."""

from __future__ import annotations

import hashlib
import os
import signal
import sqlite3
import subprocess
import threading
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatbot import failpoints
from splatbot.errors import FormatError
from splatbot.gaussians import Snapshot
from splatbot.services.problems import SaveError
from splatbot.services.store import MapStore, QuotaError, ServedMap
from splatbot.services.version_files import DamagedVersionError, read_version
from splatbot.services.version_index import Version, VersionIndex
from splatbot.services.versions import FOLDER, VersionInUseError, VersionNotFoundError, Versions, VersionsFullError
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.models import uniform_model
from tests.unit.services.test_library import disk_of


class Maps(SimpleNamespace):
    """A store with the map "desk", and its versions in a folder."""

    store: MapStore
    versions: Versions

    @property
    def desk(self) -> ServedMap:
        return self.store.get("desk")

    def grow(self, version: int) -> None:
        path = Trajectory(np.arange(float(version)), np.tile(np.eye(4), (version, 1, 1)))
        self.store.publish("desk", Snapshot(uniform_model(_means(version)), version, 1.5), path)

    def save(self, version: int, label: str | None = None, **more: Any) -> Version:
        self.grow(version)
        return self.versions.save(self.desk, None, owner="robot", label=label, **more)


def _means(version: int) -> np.ndarray:
    return np.random.default_rng(version).normal(size=(20 + version, 3))


def _maps(folder: Path, *, most: int = 10, most_bytes: int = 10**9) -> Maps:
    store = MapStore()
    store.add("desk", source="log", state="ended", workspace=Workspace(np.eye(4)), world="w", owner="robot")
    versions = Versions(folder / FOLDER, most=most, most_bytes=most_bytes, served=store.find)
    return Maps(store=store, versions=versions)


def _numbers(maps: Maps, map_id: str = "desk") -> list[int]:
    return [version.number for version in maps.versions.of_map(map_id)]


def test_a_version_is_the_map_that_was_saved(tmp_path: Path) -> None:
    maps = _maps(tmp_path)
    maps.save(3, "clean table", note="before the shift")
    maps.save(7)
    again = _maps(tmp_path)
    first, second = again.versions.of_map("desk")
    assert (first.label, first.note, first.map_version, first.gaussians) == ("clean table", "before the shift", 3, 23)
    assert (first.parent, second.parent) == (None, 1)
    with again.versions.pinned(first) as folder:
        saved = read_version(first, folder)
    np.testing.assert_array_equal(saved["snapshot"].model.means, _means(3).astype(np.float32))
    assert (saved["snapshot"].stamp, len(saved["trajectory"]), saved["source"]) == (1.5, 3, "log")


def test_the_files_are_those_that_sha256sum_and_sqlite_know(tmp_path: Path) -> None:
    """The index is read by SQLite alone, the files are checked by coreutils, the checksum follows its definition."""
    _maps(tmp_path).save(3, "a")
    with sqlite3.connect(tmp_path / FOLDER / "index.sqlite") as db:
        (folder, size, checksum), *others = db.execute("SELECT folder, bytes, checksum FROM versions").fetchall()
        assert db.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert db.execute("PRAGMA user_version").fetchone() == (1,)
    home = tmp_path / FOLDER / "files" / folder
    assert others == []
    subprocess.run(["sha256sum", "--quiet", "-c", "SHA256SUMS"], cwd=home / "map", check=True)
    sums = (home / "map" / "SHA256SUMS").read_bytes()
    assert checksum == hashlib.sha256(b"map\n" + sums).hexdigest()
    assert size == sum(path.stat().st_size for path in (home / "map").iterdir())


def test_a_number_is_used_once_and_a_label_is_a_text_alone(tmp_path: Path) -> None:
    maps = _maps(tmp_path)
    odd = "'); DROP TABLE versions; -- ../../etc/passwd"
    maps.save(1, odd)
    maps.save(2)
    maps.save(3)
    maps.versions.delete(maps.versions.get("desk", 2))
    assert maps.save(4).number == 4
    again = _maps(tmp_path)
    assert [(v.number, v.label) for v in again.versions.of_map("desk")] == [(1, odd), (3, None), (4, None)]
    with pytest.raises(VersionNotFoundError, match="no version 2"):
        again.versions.get("desk", 2)


def test_versions_of_one_state_share_their_files(tmp_path: Path) -> None:
    maps = _maps(tmp_path)
    first, second = maps.save(3), maps.versions.save(maps.desk, None, owner="other", label="the same")
    assert (first.folder, first.checksum) == (second.folder, second.checksum)
    assert len(list((tmp_path / FOLDER / "files").iterdir())) == 1
    maps.versions.delete(first)
    with maps.versions.pinned(second) as folder:
        assert len(read_version(second, folder)["snapshot"].model) == 23
    with pytest.raises(VersionInUseError, match="answers from version 2"):
        maps.versions.delete(second)
    assert (maps.versions.bytes_of("robot"), maps.versions.bytes_of("other")) == (0, second.bytes)


def test_the_oldest_without_a_label_makes_room_and_never_the_one_in_use(tmp_path: Path) -> None:
    maps = _maps(tmp_path, most=3)
    maps.save(1, "kept")
    maps.save(2)
    maps.save(3)
    maps.save(4)
    assert _numbers(maps) == [1, 3, 4]
    assert len(list((tmp_path / FOLDER / "files").iterdir())) == 3
    full = _maps(tmp_path / "full", most=2)
    full.save(1, "a")
    full.save(2, "b")
    with pytest.raises(VersionsFullError, match="2 versions already"):
        full.save(3)
    assert _numbers(full) == [1, 2]
    assert len(list((tmp_path / "full" / FOLDER / "files").iterdir())) == 2


def test_bytes_are_bounded_and_a_client_s_versions_do_not_make_room_for_those_of_another(tmp_path: Path) -> None:
    size = _maps(tmp_path / "a").save(1).bytes
    maps = _maps(tmp_path / "b", most_bytes=3 * size)
    maps.store.add("shelf", source="log", state="ended", snapshot=Snapshot(uniform_model(_means(1)), 1))
    maps.versions.save(maps.store.get("shelf"), None, owner="another")
    maps.store.publish("shelf", Snapshot(uniform_model(_means(1)), 2))  # its version is not in use any more
    for version in (1, 1, 1):
        maps.save(version)
        maps.store.remove("desk")
        maps.store.add("desk", source="log", state="ended", workspace=Workspace(np.eye(4)))
    assert _numbers(maps) == [2, 3]
    assert _numbers(maps, "shelf") == [1]
    with pytest.raises(VersionsFullError, match="bytes already"):
        maps.versions.save(
            ServedMap("big", "log", "ended", snapshot=Snapshot(uniform_model(np.zeros((999, 3))), 1)), None, owner="c"
        )
    assert len(list((tmp_path / "b" / FOLDER / "files").iterdir())) == 3


def test_a_quota_prevents_the_version_and_leaves_no_files(tmp_path: Path) -> None:
    maps = _maps(tmp_path)

    def refuse(_size: int) -> None:
        raise QuotaError("too many bytes.")

    with pytest.raises(QuotaError):
        maps.save(1, check=refuse)
    assert list((tmp_path / FOLDER / "files").iterdir()) == []


@pytest.mark.parametrize("name", ["map.ply", "map.json", "trajectory.tum", "scene.yaml", "SHA256SUMS"])
@pytest.mark.parametrize("how", ["flip", "cut", "gone", "more"])
def test_a_damaged_version_is_refused_and_the_others_work(tmp_path: Path, name: str, how: str) -> None:
    maps = _maps(tmp_path)
    bad, good = maps.save(1), maps.save(2)
    path = tmp_path / FOLDER / "files" / bad.folder / "map" / name
    data = bytearray(path.read_bytes())
    if how == "flip":
        data[len(data) // 2] ^= 4
    path.write_bytes(data[:-1] if how == "cut" else data + b" " if how == "more" else data)
    if how == "gone":
        path.unlink()
    with pytest.raises(DamagedVersionError, match="version 1 of map 'desk' is damaged"), maps.versions.pinned(bad):
        pass
    with maps.versions.pinned(good) as folder:
        assert len(read_version(good, folder)["snapshot"].model) == 22
    maps.versions.delete(bad)


def test_files_of_another_version_do_not_pass_for_it(tmp_path: Path) -> None:
    """Whole files with whole checksums are not enough: the index holds the checksum of the list."""
    maps = _maps(tmp_path)
    first, second = maps.save(1), maps.save(2)
    files = tmp_path / FOLDER / "files"
    (files / first.folder).rename(files / "kept")
    (files / second.folder).rename(files / first.folder)
    with pytest.raises(DamagedVersionError), maps.versions.pinned(first):
        pass


def test_a_version_at_work_is_neither_deleted_nor_dropped_and_its_files_outlive_the_map(tmp_path: Path) -> None:
    maps = _maps(tmp_path, most=2)
    first = maps.save(1)
    maps.save(2)
    with maps.versions.pinned(first) as folder:
        with pytest.raises(VersionInUseError, match="a request works on version 1"):
            maps.versions.delete(first)
        with pytest.raises(VersionsFullError):
            maps.versions.save(maps.desk, None, owner="robot")
        maps.versions.remove_map("desk")
        assert _numbers(maps) == []
        assert len(read_version(first, folder)["snapshot"].model) == 21
    assert list((tmp_path / FOLDER / "files").iterdir()) == []
    with pytest.raises(VersionNotFoundError), maps.versions.pinned(first):
        pass


def test_the_next_map_of_a_deleted_name_has_no_versions_of_it(tmp_path: Path) -> None:
    maps = _maps(tmp_path)
    maps.save(1, "a")
    maps.versions.remove_map("desk")
    assert maps.save(2).number == 1
    assert [v.label for v in _maps(tmp_path).versions.of_map("desk")] == [None]


def test_threads_that_save_and_delete_at_once_leave_whole_versions(tmp_path: Path) -> None:
    maps = _maps(tmp_path, most=50)
    maps.grow(1)
    errors: list[BaseException] = []

    def work(label: str) -> None:
        try:
            for k in range(4):
                made = maps.versions.save(maps.desk, None, owner="robot", label=f"{label} {k}")
                if k % 2:
                    maps.versions.delete(made)
        except VersionInUseError:
            pass
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(name,)) for name in "abc"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    numbers = _numbers(maps)
    assert len(set(numbers)) == len(numbers)
    assert [v.number for v in _maps(tmp_path).versions.of_map("desk")] == numbers


def _child(folder: Path, choice: str, ack: int) -> None:
    """Save three versions, delete the second, and acknowledge each step."""
    failpoints.arm(choice)
    maps = _maps(folder)
    for version in (1, 2, 3):
        maps.save(version, f"v{version}")
        os.write(ack, b".")
    maps.versions.delete(maps.versions.get("desk", 2))
    os.write(ack, b".")


def _killed(folder: Path, choice: str) -> tuple[bool, int]:
    """Run :func:`_child` in a fork; return whether it was killed, and the number of acknowledged steps."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(reader)
            _child(folder, choice, writer)
        finally:
            os._exit(0)
    os.close(writer)
    _, status = os.waitpid(pid, 0)
    with os.fdopen(reader, "rb") as file:
        done = len(file.read())
    return os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL, done


STEPS: list[set[int]] = [set(), {1}, {1, 2}, {1, 2, 3}, {1, 3}]


@pytest.mark.parametrize(("torn", "step"), [("", 4), (":torn", 5), pytest.param("", 1, marks=pytest.mark.long)])
def test_killed_at_any_point_each_version_is_whole_or_absent(tmp_path: Path, torn: str, step: int) -> None:
    """A process is killed at every write, flush, rename and commit in turn; whole files without a row are set aside."""
    point, kills = 1 - step, 0
    while True:
        point += step
        folder = tmp_path / str(point)
        killed, done = _killed(folder, f"any:{point}{torn}")
        maps = _maps(folder)
        found = {version.number for version in maps.versions.of_map("desk")}
        assert found in STEPS[done : done + 2], (point, done, found)
        for version in maps.versions.of_map("desk"):
            with maps.versions.pinned(version) as files:
                assert len(read_version(version, files)["snapshot"].model) == 20 + version.number
        names = {path.name for path in (folder / FOLDER / "files").iterdir()}
        unnamed = {name for name in names if name.endswith(".unnamed")}
        assert names - unnamed == {version.folder for version in maps.versions.of_map("desk")}
        assert len(unnamed) <= 1
        kills += killed
        if not killed:
            break
    assert done == 4
    assert kills >= 60 // step


def test_an_index_of_a_later_splatbot_or_of_no_database_is_named_and_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "index.sqlite"
    VersionIndex(path)
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA user_version=2")
    with pytest.raises(FormatError, match="has schema 2"):
        VersionIndex(path)
    path.write_bytes(b"no database" * 1000)
    with pytest.raises(FormatError, match=r"index.sqlite: is damaged .*Fix: restore it from a copy"):
        VersionIndex(path)
    assert path.read_bytes() == b"no database" * 1000


def test_an_index_that_vanishes_is_a_failed_save_and_is_not_made_again(tmp_path: Path) -> None:
    maps = _maps(tmp_path)
    maps.save(1)
    for path in (tmp_path / FOLDER).glob("index.sqlite*"):
        path.unlink()
    with pytest.raises(SaveError, match="index of versions cannot be used"):
        maps.save(2)
    assert not (tmp_path / FOLDER / "index.sqlite").exists()
    assert _numbers(maps) == [1]


@pytest.mark.parametrize("how", ["gone", "empty", "without tables"])
def test_a_lost_index_is_named_at_the_start_and_no_version_is_lost(tmp_path: Path, how: str) -> None:
    maps = _maps(tmp_path)
    for version in (1, 2):
        maps.save(version)
    index, files = tmp_path / FOLDER / "index.sqlite", tmp_path / FOLDER / "files"
    copy, before = index.read_bytes(), sorted(files.rglob("*"))
    index.unlink()
    if how == "empty":
        index.touch()
    elif how == "without tables":
        with sqlite3.connect(index) as db:
            db.execute("PRAGMA journal_mode=WAL")
    for _ in range(2):  # a failed start does not make the index that the next one finds
        with pytest.raises(FormatError, match=r"index.sqlite: .*files of versions.*Fix: restore it from a copy"):
            _maps(tmp_path)
    assert sorted(files.rglob("*")) == before
    for path in index.parent.glob("index.sqlite*"):
        path.unlink()
    index.write_bytes(copy)
    assert _numbers(_maps(tmp_path)) == [1, 2]


def test_whole_folders_that_no_version_names_are_set_aside_and_drafts_removed(tmp_path: Path) -> None:
    first = _maps(tmp_path).save(1)
    files = tmp_path / FOLDER / "files"
    for name in ("0123456789abcdef", "fedcba9876543210.draft"):
        (files / name).mkdir()
        (files / name / "map.ply").write_bytes(b"kept")
    for _ in range(2):
        _maps(tmp_path)
        assert {path.name for path in files.iterdir()} == {first.folder, "0123456789abcdef.unnamed"}
    assert (files / "0123456789abcdef.unnamed" / "map.ply").read_bytes() == b"kept"


def test_a_refused_save_deletes_nothing(tmp_path: Path) -> None:
    size = _maps(tmp_path / "a").save(1).bytes
    maps = _maps(tmp_path / "b", most_bytes=4 * size)
    for version in (1, 2, 3):
        maps.save(version)
    large = Snapshot(uniform_model(np.zeros((2000, 3))), 4)
    maps.store.publish("desk", large)
    with pytest.raises(VersionsFullError, match="bytes already"):
        maps.versions.save(maps.desk, None, owner="robot")

    def refuse(_size: int) -> None:
        raise QuotaError("too many bytes.")

    full = _maps(tmp_path / "c", most=2)
    full.save(1)
    full.save(2)
    with pytest.raises(QuotaError):
        full.save(3, check=refuse)
    with sqlite3.connect(tmp_path / "c" / FOLDER / "index.sqlite") as db:
        db.execute("CREATE TRIGGER broken BEFORE INSERT ON versions BEGIN SELECT RAISE(ABORT, 'no'); END")
    with pytest.raises(FormatError):
        full.save(3)
    for kept, numbers in ((maps, [1, 2, 3]), (full, [1, 2])):
        assert _numbers(kept) == numbers
        for found in kept.versions.of_map("desk"):
            with kept.versions.pinned(found):
                pass
        assert len(list(kept.versions.files.folder.iterdir())) == len(numbers)


def test_a_version_whose_files_a_labelled_one_shares_makes_no_room_for_bytes(tmp_path: Path) -> None:
    size = _maps(tmp_path / "a").save(1).bytes
    maps = _maps(tmp_path / "b", most_bytes=3 * size)
    maps.save(1)
    maps.versions.save(maps.desk, None, owner="robot", label="the same")
    maps.save(2)
    maps.save(3)
    assert _numbers(maps) == [1, 2, 4]


@pytest.mark.parametrize("how", ["save", "repeat"])
def test_shared_files_count_once_for_each_client_that_has_them(tmp_path: Path, how: str) -> None:
    maps, sizes = _maps(tmp_path), list[int]()
    first = maps.save(1)

    def share(owner: str) -> None:
        if how == "save":
            maps.versions.save(maps.desk, None, owner=owner, check=sizes.append)
        else:
            maps.versions.repeat(first, owner=owner, map_version=2, check=sizes.append)

    share("robot")
    assert sizes == []
    share("other")
    share("other")
    assert sizes == [first.bytes]


def test_a_reserve_that_could_not_be_written_is_written_later(tmp_path: Path) -> None:
    index, reserve = VersionIndex(tmp_path / "index.sqlite"), tmp_path / "reserve"
    with disk_of(1000):
        index.keep_reserve()
    assert not reserve.exists()
    reserve.write_bytes(b"")  # as an earlier splatbot left it
    index.keep_reserve()
    assert reserve.stat().st_size == 1 << 17


def test_on_a_full_disk_a_version_can_be_deleted(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.getuid() != 0 or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "none", disk]).returncode:
        pytest.skip("needs the right to mount a tmpfs")
    try:
        maps = _maps(disk)
        maps.save(1)
        maps.save(2)
        with (disk / "filler").open("wb", buffering=0) as file, suppress(OSError):
            while file.write(bytes(4096)):
                pass
        with pytest.raises(SaveError):
            maps.save(3)
        maps.versions.delete(maps.versions.get("desk", 1))
        assert _numbers(maps) == [2]
        (disk / "filler").unlink()
        maps.save(4)
        assert [v.number for v in _maps(disk).versions.of_map("desk")] == [2, 3]
    finally:
        subprocess.run(["umount", "-l", disk], check=False)
