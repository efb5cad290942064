"""A public recording: fetched, checked, unpacked; after every fault its folder is whole or missing."""

from __future__ import annotations

import fcntl
import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatbot.downloads import ArchiveError, Downloaded, DownloadError, Patience, PublicRecording, download
from splatbot.errors import InputError
from splatbot.logs import open_log
from tests.unit.downloads.server import FileServer, cut, refuse, tgz, zipped

ROOT = "rgbd_dataset_freiburg1_desk"
PATIENCE = Patience(attempts=2, first_wait=0.0, timeout=2.0)
HTML = b"<!DOCTYPE html><title>Sign in to the network</title>"


@pytest.fixture
def recording(server: FileServer, make_log: Callable[..., Path]) -> PublicRecording:
    """A small recording in TUM layout on the server, of unknown size and digest."""
    url = server.add("/rgbd/desk.tgz", tgz(make_log(3), ROOT))
    return PublicRecording("tum/fr1_desk", url, ROOT, "CC BY 4.0", camera="tum_fr1")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder that a download creates."""
    return tmp_path / "recordings" / "desk"


def get(recording: PublicRecording, folder: Path, url_base: str | None = None) -> Downloaded:
    """Fetch a recording without long waits."""
    return download(recording, folder, url_base=url_base, patience=PATIENCE)


def checked(recording: PublicRecording, server: FileServer) -> PublicRecording:
    """Return a recording whose size and digest the catalogue has."""
    content = server.files["/rgbd/desk.tgz"]
    return replace(recording, size=len(content), sha256=hashlib.sha256(content).hexdigest())


def names(folder: Path) -> set[str]:
    """Return the names of the files in a folder, and none if it does not exist."""
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def test_a_download_that_is_cut_and_continued_opens_as_the_log_that_was_packed(
    server: FileServer, recording: PublicRecording, folder: Path, tmp_path: Path
) -> None:
    server.answers += [cut(2000), refuse(404)]
    with pytest.raises(DownloadError, match="404"):
        get(recording, folder)
    assert not folder.exists()
    found = get(recording, folder)
    assert server.ranges == [None, "bytes=2000-", "bytes=2000-"]
    assert found.fresh
    assert found.log == folder
    ours, packed = open_log(found.log), open_log(tmp_path / "log")
    assert len(ours) == len(packed) == 3
    for one, other in zip(ours, packed, strict=True):
        np.testing.assert_array_equal(one.rgb, other.rgb)
        np.testing.assert_array_equal(one.depth, other.depth)
    assert names(folder.parent) == {"desk", "desk.sha256"}


def test_a_complete_folder_is_not_fetched_again(server: FileServer, recording: PublicRecording, folder: Path) -> None:
    first = get(recording, folder)
    second = get(recording, folder)
    assert len(server.requests) == 1
    assert second == replace(first, fresh=False)
    assert json.loads((folder / "download.json").read_text())["terms"] == "CC BY 4.0"


def test_an_empty_folder_is_filled(recording: PublicRecording, folder: Path) -> None:
    folder.mkdir(parents=True)
    assert get(recording, folder).fresh


@pytest.mark.parametrize("account", [None, b"", b"[]", b"{}", b"\xff", b'{"name": "tum/fr1_xyz", "sha256": "0"}'])
def test_other_folders_are_not_touched(
    server: FileServer, recording: PublicRecording, folder: Path, account: bytes | None
) -> None:
    folder.mkdir(parents=True)
    (folder / "mine.txt").write_text("mine")
    if account is not None:
        (folder / "download.json").write_bytes(account)
    with pytest.raises(InputError, match=r"exists, and is not tum/fr1_desk.*--out"):
        get(recording, folder)
    assert (folder / "mine.txt").read_text() == "mine"
    assert server.requests == []


@pytest.mark.parametrize("place", [".", "..", "/", "a/.."])
def test_a_folder_without_a_name_is_refused(recording: PublicRecording, place: str) -> None:
    with pytest.raises(InputError, match="name a new folder"):
        get(recording, Path(place))


def test_an_archive_of_known_digest_is_checked_and_not_pinned(
    server: FileServer, recording: PublicRecording, folder: Path
) -> None:
    found = get(checked(recording, server), folder)
    assert found.pin is None
    assert names(folder.parent) == {"desk"}


def test_an_archive_of_another_digest_is_removed(server: FileServer, recording: PublicRecording, folder: Path) -> None:
    expected = checked(recording, server)
    content = bytearray(server.files["/rgbd/desk.tgz"])
    content[-20] ^= 1
    server.add("/rgbd/desk.tgz", bytes(content))
    with pytest.raises(ArchiveError) as raised:
        get(expected, folder)
    assert str(expected.sha256) in str(raised.value)
    assert hashlib.sha256(content).hexdigest() in str(raised.value)
    assert names(folder.parent) == set()


def test_a_first_download_is_pinned_in_the_format_of_sha256sum(
    server: FileServer, recording: PublicRecording, folder: Path
) -> None:
    found = get(recording, folder)
    digest = hashlib.sha256(server.files["/rgbd/desk.tgz"]).hexdigest()
    assert found.sha256 == digest
    assert found.pin is not None
    assert found.pin.read_text() == f"{digest}  desk.tgz\n"


def test_a_later_download_must_equal_the_pin(
    server: FileServer, recording: PublicRecording, folder: Path, make_log: Callable[..., Path]
) -> None:
    get(recording, folder)
    shutil.rmtree(folder)
    server.add("/rgbd/desk.tgz", tgz(make_log(2, name="other"), ROOT))
    with pytest.raises(ArchiveError, match=r"changed since the first download; delete .*desk\.sha256"):
        get(recording, folder)
    assert names(folder.parent) == {"desk.sha256"}
    (folder.parent / "desk.sha256").unlink()
    assert get(recording, folder).fresh


@pytest.mark.parametrize("pin", [b"", b"\n\n", b"abc  desk.tgz\n", b"\xff" * 10_000])
def test_a_damaged_pin_is_an_error(server: FileServer, recording: PublicRecording, folder: Path, pin: bytes) -> None:
    folder.parent.mkdir(parents=True)
    (folder.parent / "desk.sha256").write_bytes(pin)
    with pytest.raises(InputError, match="holds no sha256"):
        get(recording, folder)
    assert server.requests == []


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(HTML, id="page of a network"),
        pytest.param(zipped({"../../evil": b"x"}), id="leaves the folder"),
        pytest.param(zipped({f"{ROOT}/zeros": bytes(30 << 20)}), id="bomb"),
        pytest.param(zipped({"other/rgb.txt": b""}), id="other folder"),
        pytest.param(zipped({ROOT: b"a file"}), id="file in place of the folder"),
        pytest.param(b"", id="empty"),
    ],
)
def test_a_hostile_archive_leaves_nothing(
    server: FileServer, recording: PublicRecording, folder: Path, tmp_path: Path, content: bytes
) -> None:
    server.add("/rgbd/desk.tgz", content)
    with pytest.raises(ArchiveError):
        get(recording, folder)
    assert names(folder.parent) == set()
    assert names(tmp_path) == {"log", "recordings"}


def test_a_full_disk_is_an_error_before_the_first_byte(
    recording: PublicRecording, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage("/")._replace(free=4000)
    monkeypatch.setattr("splatbot.downloads.shutil.disk_usage", lambda path: usage)
    with pytest.raises(DownloadError, match=r"the disk has 0\.0 GB .* Fix: free some space"):
        get(recording, folder)
    assert names(folder.parent) == set()


@pytest.mark.parametrize("step", ["fetching", "checking", "unpacking"])
def test_an_interrupted_call_is_continued_without_loss(
    server: FileServer, recording: PublicRecording, folder: Path, step: str
) -> None:
    def interrupt(name: str, done: int, total: int | None) -> None:
        if name == step and done > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download(recording, folder, step=interrupt, patience=PATIENCE)
    assert names(folder.parent) == {".desk.download"}
    assert "unpacked" not in names(folder.parent / ".desk.download")
    assert get(recording, folder).fresh
    assert names(folder.parent) == {"desk", "desk.sha256"}
    assert len(server.requests) <= 2
    if len(server.requests) == 2:
        assert server.ranges[1] is not None


def test_files_of_a_killed_process_are_replaced(server: FileServer, recording: PublicRecording, folder: Path) -> None:
    unpacked = folder.parent / ".desk.download" / "unpacked" / ROOT
    unpacked.mkdir(parents=True)
    (unpacked / "rgb.txt").write_text("half")
    (unpacked.parents[1] / "desk.tgz").write_bytes(server.files["/rgbd/desk.tgz"])
    get(recording, folder)
    assert server.requests == []
    assert len(open_log(folder)) == 3


def test_two_downloads_of_one_folder_exclude_each_other(
    server: FileServer, recording: PublicRecording, folder: Path
) -> None:
    work = folder.parent / ".desk.download"
    work.mkdir(parents=True)
    with (work / "lock").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="another process"):
            get(recording, folder)
    assert server.requests == []
    assert get(recording, folder).fresh


def test_a_mirror_replaces_scheme_and_host(server: FileServer, recording: PublicRecording, folder: Path) -> None:
    server.add("/mirror/rgbd/desk.tgz", server.files["/rgbd/desk.tgz"])
    official = replace(recording, url="https://official.example/rgbd/desk.tgz")
    base = f"{server.base}/mirror/".replace("http://", "http://ann:secret@")
    get(official, folder, url_base=base)
    assert [path for path, _ in server.requests] == ["/mirror/rgbd/desk.tgz"]
    assert "secret" not in (folder / "download.json").read_text()


@pytest.mark.parametrize(
    "base", ["mirror.example", "ftp://mirror", "https://", "https://[", "http://a:99999", "file:///a"]
)
def test_a_base_that_is_no_address_is_refused(recording: PublicRecording, folder: Path, base: str) -> None:
    with pytest.raises(InputError, match="is no address"):
        get(recording, folder, url_base=base)


def test_http_beyond_this_machine_needs_a_digest(recording: PublicRecording, folder: Path) -> None:
    with pytest.raises(InputError, match=r"http needs a known digest.*sha256sum"):
        get(recording, folder, url_base="http://mirror.invalid")
    (folder.parent / "desk.sha256").write_text("0" * 64)
    with pytest.raises(DownloadError, match=r"mirror\.invalid"):  # the request is sent
        get(recording, folder, url_base="http://mirror.invalid")


def test_zipped_sequences_of_a_scene_are_unpacked(server: FileServer, folder: Path) -> None:
    frames = {f"seq-01/frame-{i:06d}.color.png": np.random.default_rng(i).bytes(500) for i in range(3)}
    scene = zipped({"chess/seq-01.zip": zipped(frames), "chess/TrainSplit.txt": b"sequence1\n"})
    url = server.add("/chess.zip", scene)
    found = get(PublicRecording("7scenes/chess", url, "chess", "terms", log="seq-01"), folder)
    assert found.log == folder / "seq-01"
    assert {f"seq-01/{path.name}": path.read_bytes() for path in found.log.iterdir()} == frames
    assert names(folder) == {"seq-01", "TrainSplit.txt", "download.json"}
