"""Archives: sound ones unpack to the same files; hostile and damaged ones write nothing outside, and end early."""

from __future__ import annotations

import gzip
import io
import os
import stat
import struct
import tarfile
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatbot.downloads import ArchiveError
from splatbot.downloads import archives as module
from splatbot.downloads.archives import unpack, unpack_inner
from tests.unit.downloads.server import tgz, zipped

NOISE = np.random.default_rng(3).bytes(40_000)
FILES = {"seq/rgb.txt": b"0.0 rgb/0.png\n", "seq/rgb/0.png": NOISE, "seq/empty": b""}
MOST = 1 << 20


def unpacked(archive: bytes, folder: Path, *, most: int = MOST) -> dict[str, bytes]:
    """Unpack an archive, and return its files by name."""
    (folder / "a.tgz").write_bytes(archive)
    unpack(folder / "a.tgz", folder / "out", max_bytes=most, progress=lambda done: None)
    return contents(folder / "out")


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder by name."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def tarred(*members: tarfile.TarInfo | tuple[str, bytes], layout: int = tarfile.PAX_FORMAT) -> bytes:
    """Pack files, or members without content, as .tar.gz."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz", format=layout) as tar:
        for member in members:
            if isinstance(member, tarfile.TarInfo):
                tar.addfile(member)
                continue
            info = tarfile.TarInfo(member[0])
            info.size = len(member[1])
            tar.addfile(info, io.BytesIO(member[1]))
    return packed.getvalue()


def special(kind: bytes, target: str = "") -> tarfile.TarInfo:
    """Return a member that is no file."""
    info = tarfile.TarInfo("seq/rgb.txt")
    info.type, info.linkname = kind, target
    return info


def test_a_tar_archive_unpacks_to_the_same_files(tmp_path: Path) -> None:
    for name, content in FILES.items():
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).write_bytes(content)
    assert unpacked(tgz(tmp_path / "in" / "seq", "seq"), tmp_path) == FILES


@pytest.mark.parametrize("layout", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_long_names_and_names_of_any_language_are_kept(tmp_path: Path, layout: int) -> None:
    files = {f"{'a' * 90}/{'b' * 90}.txt": b"1", "stühle/椅子.png": NOISE}
    assert unpacked(tarred(*files.items(), layout=layout), tmp_path) == files


def test_a_zip_archive_unpacks_to_the_same_files(tmp_path: Path) -> None:
    assert unpacked(zipped(FILES), tmp_path) == FILES


@pytest.mark.parametrize("name", ["../evil", "/evil", "a/../../evil", "..\\evil", "a/..", "C:\\evil"])
@pytest.mark.parametrize("pack", [lambda name: tarred((name, b"x")), lambda name: zipped({name: b"x"})])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, pack: Callable[[str], bytes], name: str) -> None:
    place = tmp_path / "place"
    place.mkdir()
    with pytest.raises(ArchiveError, match="leaves the folder"):
        unpacked(pack(name), place)
    assert contents(tmp_path).keys() == {"place/a.tgz"}
    assert not Path("/evil").exists()


@pytest.mark.parametrize(
    "member",
    [
        special(tarfile.SYMTYPE, "/etc/passwd"),
        special(tarfile.SYMTYPE, "rgb/0.png"),
        special(tarfile.LNKTYPE, "seq/rgb/0.png"),
        special(tarfile.FIFOTYPE),
        special(tarfile.CHRTYPE),
        special(tarfile.BLKTYPE),
    ],
    ids=["link outside", "link inside", "hard link", "pipe", "character device", "block device"],
)
def test_members_of_a_tar_that_are_no_files_are_refused(tmp_path: Path, member: tarfile.TarInfo) -> None:
    with pytest.raises(ArchiveError, match="no plain file"):
        unpacked(tarred(("seq/rgb/0.png", NOISE), member), tmp_path)
    assert not any(path.is_symlink() for path in (tmp_path / "out").rglob("*"))


def test_sparse_members_are_refused(tmp_path: Path) -> None:
    """The map of a hostile sparse file lets tarfile search its end forever."""
    info = tarfile.TarInfo("a")
    header = bytearray(info.tobuf(tarfile.GNU_FORMAT))
    header[156:157] = tarfile.GNUTYPE_SPARSE
    header[386:398], header[398:410] = b"00000000100\0", b"00000000001\0"
    header[483:495] = b"77777777777\0"
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    with pytest.raises(ArchiveError, match="no plain file"):
        unpacked(gzip.compress(bytes(header) + bytes(2048)), tmp_path)


def test_links_and_encrypted_members_of_a_zip_are_refused(tmp_path: Path) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as pack:
        link = zipfile.ZipInfo("seq/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        pack.writestr(link, "/etc")
    with pytest.raises(ArchiveError, match="no plain file"):
        unpacked(packed.getvalue(), tmp_path)
    locked = bytearray(zipped({"a": b"x"}))
    locked[locked.index(b"PK\x01\x02") + 8] |= 1
    (tmp_path / "b").mkdir()
    with pytest.raises(ArchiveError, match="no plain file"):
        unpacked(bytes(locked), tmp_path / "b")


@pytest.mark.parametrize(
    "archive",
    [
        tarred(("a", b"1"), ("a", b"2")),
        tarred(("a", b"1"), ("a/b", b"2")),
        tarred(("a/b", b"1"), ("a", b"2")),
        tarred(("a" * 300, b"1")),
        tarred(("", b"1")),
        tarred((".", b"1")),
        zipped({"a": b"1", "a/b": b"2"}),
        zipped({"a" * 300: b"1"}),
    ],
    ids=["twice", "below a file", "above a file", "long", "empty", "dot", "zip below a file", "zip long"],
)
def test_names_that_no_folder_can_hold_are_refused(tmp_path: Path, archive: bytes) -> None:
    with pytest.raises(ArchiveError, match="impossible name"):
        unpacked(archive, tmp_path)


@pytest.mark.parametrize(
    "archive",
    [
        lambda: tarred(("zeros", bytes(50 << 20))),
        lambda: zipped({"zeros": bytes(50 << 20)}),
        lambda: tarred(*[(f"{i}", bytes(200_000)) for i in range(100)]),
        lambda: zipped({f"{i}": bytes(200_000) for i in range(100)}),
        lambda: gzip.compress(tarfile.TarInfo("a").tobuf() + bytes(50 << 20)),
    ],
    ids=["tar", "zip", "tar of many", "zip of many", "padding"],
)
def test_bombs_end_at_the_limit(tmp_path: Path, archive: Callable[[], bytes]) -> None:
    with pytest.raises(ArchiveError, match="unpacks to more than 1048576 bytes"):
        unpacked(archive(), tmp_path)
    assert sum(path.stat().st_size for path in (tmp_path / "out").rglob("*") if path.is_file()) <= MOST


def test_a_header_of_hostile_size_takes_no_memory(tmp_path: Path) -> None:
    info = tarfile.TarInfo("././@PaxHeader")
    info.type, info.size = tarfile.XHDTYPE, 200 << 20
    archive = gzip.compress(info.tobuf(tarfile.USTAR_FORMAT) + bytes(200 << 20), 1)
    tracemalloc.start()
    try:
        with pytest.raises(ArchiveError, match="a header has 209715200 bytes"):
            unpacked(archive, tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", [tarfile.XHDTYPE, tarfile.GNUTYPE_LONGNAME])
def test_headers_that_nest_without_end_are_refused(tmp_path: Path, kind: bytes) -> None:
    info = tarfile.TarInfo("a")
    info.type, info.size = kind, 6
    block = info.tobuf(tarfile.USTAR_FORMAT) + b"6 a=b\n".ljust(512, b"\0")
    with pytest.raises(ArchiveError, match="damaged"):
        unpacked(gzip.compress(block * 5000), tmp_path)


def test_a_size_in_a_zip_that_is_too_small_is_refused(tmp_path: Path) -> None:
    archive = bytearray(zipped({"a": bytes(500_000)}))
    for signature, place in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        struct.pack_into("<I", archive, archive.index(signature) + place, 10)
    with pytest.raises(ArchiveError, match="damaged"):
        unpacked(bytes(archive), tmp_path)


@pytest.mark.parametrize("pack", [tarred(*FILES.items()), zipped(FILES)], ids=["tar", "zip"])
def test_truncated_and_altered_archives_are_refused(tmp_path: Path, pack: bytes, rng: np.random.Generator) -> None:
    cuts = [pack[:n] for n in (0, 1, 3, 4, 20, 400, len(pack) // 2, len(pack) - 9, len(pack) - 1)]
    altered = []
    for place in rng.integers(100, 39_000, 10):  # of the compressed noise
        copy = bytearray(pack)
        copy[place] ^= 0x55
        altered.append(bytes(copy))
    for number, archive in enumerate(cuts + altered):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        with pytest.raises(ArchiveError):
            unpacked(archive, folder)


def test_random_bytes_never_cause_another_error(tmp_path: Path, rng: np.random.Generator) -> None:
    for number in range(300):
        pack = bytearray(tarred(*FILES.items()) if number % 2 else zipped(FILES))
        inner = bytearray(gzip.decompress(pack)) if number % 4 == 1 else pack
        places = np.r_[rng.integers(0, min(2048, len(inner)), 3), len(inner) - 1 - rng.integers(0, 300, 3)]
        for place in places:
            inner[place] = rng.integers(256)
        folder = tmp_path / f"{number}"
        folder.mkdir()
        try:
            unpacked(gzip.compress(inner, 1) if number % 4 == 1 else bytes(inner), folder)
        except ArchiveError:
            continue


@pytest.mark.parametrize(
    "archive", [b"<!DOCTYPE html><html>", b"", b"\x1f\x8b", b"PK\x03\x04", b"PK\x05\x06" + bytes(18)]
)
def test_other_files_are_named(tmp_path: Path, archive: bytes) -> None:
    with pytest.raises(ArchiveError, match=r"neither \.tar\.gz nor \.zip|damaged"):
        unpacked(archive, tmp_path)


def test_the_number_of_files_has_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MAX_FILES", 2)
    with pytest.raises(ArchiveError, match="more than 2 files"):
        unpacked(tarred(*FILES.items()), tmp_path)


def test_inner_archives_are_replaced_by_their_files(tmp_path: Path) -> None:
    for sequence in ("seq-01", "seq-02"):
        (tmp_path / f"{sequence}.zip").write_bytes(zipped({f"{sequence}/frame-000000.color.png": NOISE}))
    unpack_inner(tmp_path, max_bytes=MOST, progress=lambda done: None)
    assert contents(tmp_path) == {f"seq-0{i}/frame-000000.color.png": NOISE for i in (1, 2)}


def test_inner_archives_share_one_limit(tmp_path: Path) -> None:
    for number in range(4):
        (tmp_path / f"{number}.zip").write_bytes(zipped({f"{number}/a": bytes(400_000)}))
    with pytest.raises(ArchiveError, match="unpacks to more"):
        unpack_inner(tmp_path, max_bytes=MOST, progress=lambda done: None)


def test_files_get_the_permissions_of_the_user_alone(tmp_path: Path) -> None:
    info = tarfile.TarInfo("a")
    info.mode, info.uid = 0o6777, 0
    unpacked(tarred(info), tmp_path)
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE((tmp_path / "out" / "a").stat().st_mode) == 0o666 & ~mask
