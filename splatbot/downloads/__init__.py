"""Public recordings: fetched, checked, unpacked, and under their name only when they are whole."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from splatbot.atomic import atomic_write, replace
from splatbot.downloads.archives import unpack, unpack_inner
from splatbot.downloads.catalogue import PublicRecording, catalogue, find_recording
from splatbot.downloads.errors import ArchiveError, DownloadError
from splatbot.downloads.transfer import Patience, fetch, shown
from splatbot.errors import InputError

__all__ = [
    "ArchiveError",
    "DownloadError",
    "Downloaded",
    "Patience",
    "PublicRecording",
    "catalogue",
    "download",
    "find_recording",
]

ACCOUNT = "download.json"
"""File of a downloaded folder that names its source, its digest and its terms."""

PATIENCE = Patience()

_EXPANSION = 1.25  # unpacked bytes of an archive of images, for each byte of the archive
_MAX_EXPANSION = 4.0
_MAX_ARCHIVE = 64 << 30  # bytes
_CHUNK = 1 << 20
_LOOPBACK = ("127.0.0.1", "::1", "localhost")

Step = Callable[[str, int, int | None], None]
"""Show a step, the bytes that are done, and all bytes if they are known."""


@dataclass(frozen=True)
class Downloaded:
    """A downloaded recording.

    Args:
        folder: the folder that was unpacked.
        log: the recording in it, for :func:`splatbot.logs.open_log`.
        sha256: digest of the archive.
        fresh: it was fetched by this call, and not by an earlier one.
        pin: file of the digest that later downloads must equal. If None, the catalogue has the digest.
    """

    folder: Path
    log: Path
    sha256: str
    fresh: bool
    pin: Path | None


def download(
    recording: PublicRecording,
    folder: Path,
    *,
    url_base: str | None = None,
    step: Step = lambda name, done, total: None,
    notice: Callable[[str], None] = lambda sentence: None,
    patience: Patience = PATIENCE,
) -> Downloaded:
    """Fetch, check and unpack a public recording; a complete folder is returned as it is.

    The archive, whole or in part, and the unpacked files are in ``.NAME.download`` next to the folder until it is
    complete. A later call continues there. An archive of unknown digest is pinned: ``NAME.sha256`` next to the folder
    keeps the digest, in the format of ``sha256sum``.

    Args:
        recording: an entry of the catalogue.
        folder: the folder to create.
        url_base: address that replaces scheme and host of the official address, for a mirror.
        step: called with a step and its progress.
        notice: called with a sentence before each wait for the server.
        patience: limits of waiting.

    Raises:
        InputError: the folder holds other files, the address is not allowed, or another process downloads there.
        DownloadError: the server does not deliver the archive, or the disk has too little space.
        ArchiveError: the archive is not the expected one, or is damaged; it is removed.
        OSError: the disk is full or not available.
    """
    if folder.name in ("", ".."):
        raise InputError("has no name of its own.", file=folder, field="--out", hint="name a new folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    pin = _pin(folder)
    with _working_folder(folder) as work:
        if account := _account(recording, folder):
            return _result(recording, folder, str(account["sha256"]), fresh=False)
        expected = recording.sha256 or _read_pin(pin)
        url = _address(recording, url_base, expected is not None, pin)
        archive = work / recording.archive
        if not archive.exists():
            fetch(
                url,
                archive,
                size=recording.size,
                room=partial(_room, work),
                progress=partial(step, "fetching"),
                notice=notice,
                patience=patience,
            )
        digest = _digest(archive, partial(step, "checking"))
        try:
            _check_digest(digest, expected, recording, pin)
            draft = _unpack(recording, archive, work, partial(step, "unpacking"))
        except ArchiveError:
            archive.unlink()
            raise
        _write_account(recording, draft, shown(url), digest)
        if expected is None:
            with atomic_write(pin) as file:
                file.write(f"{digest}  {recording.archive}\n".encode())
        os.sync()  # thousands of files, before the name that marks them as whole
        replace(draft, folder)
        return _result(recording, folder, digest, fresh=True)


@contextmanager
def _working_folder(folder: Path) -> Iterator[Path]:
    """Create and lock the folder of unfinished files; after an error it stays if it has a part of the archive."""
    work = folder.parent / f".{folder.name}.download"
    work.mkdir(exist_ok=True)
    with (work / "lock").open("wb") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            hint = "wait until it ends, or choose another folder"
            raise InputError("another process downloads here.", file=folder, field="--out", hint=hint) from error
        complete = False
        try:
            yield work
            complete = True
        finally:
            shutil.rmtree(work / "unpacked", ignore_errors=True)
            if complete or [path.name for path in work.iterdir()] == ["lock"]:
                shutil.rmtree(work, ignore_errors=True)


def _account(recording: PublicRecording, folder: Path) -> dict[str, Any] | None:
    """Return the account of the download that a folder holds; None if there is no folder, or an empty one.

    Raises:
        InputError: it holds other files.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return None
    try:
        account = json.loads((folder / ACCOUNT).read_text(encoding="utf-8"))
        if account["name"] == recording.name and account["sha256"]:
            return dict(account)
    except (OSError, ValueError, TypeError, KeyError):
        pass
    hint = "choose another folder with --out"
    raise InputError(f"exists, and is not {recording.name}.", file=folder, field="--out", hint=hint)


def _write_account(recording: PublicRecording, draft: Path, url: str, digest: str) -> None:
    account = {"name": recording.name, "url": url, "sha256": digest, "terms": recording.terms}
    (draft / ACCOUNT).write_text(json.dumps(account, indent=2) + "\n", encoding="utf-8")


def _result(recording: PublicRecording, folder: Path, digest: str, *, fresh: bool) -> Downloaded:
    return Downloaded(folder, folder / recording.log, digest, fresh, None if recording.sha256 else _pin(folder))


def _address(recording: PublicRecording, url_base: str | None, checked: bool, pin: Path) -> str:
    """Return the address of the archive.

    Raises:
        InputError: the base is no address, or sends an archive of unknown digest without encryption.
    """
    if url_base is None:
        return recording.url
    try:
        base = urlsplit(url_base)
        host, _ = base.hostname, base.port
    except ValueError:
        base, host = urlsplit(""), None
    if base.scheme not in ("https", "http") or not host or base.query or base.fragment:
        hint = "write the scheme and the host, as in https://mirror.example.org/data"
        raise InputError(f"{url_base[:80]!r} is no address.", field="--url-base", hint=hint)
    if base.scheme == "http" and not checked and host not in _LOOPBACK:
        hint = f"use https, or write the digest that you trust into {pin} (sha256sum ARCHIVE > {pin})"
        raise InputError("http needs a known digest.", field="--url-base", hint=hint)
    return url_base.rstrip("/") + urlsplit(recording.url).path


def _room(work: Path, total: int | None, here: int) -> int:
    """Return the most bytes of an archive of ``total`` bytes, ``here`` of which are on the disk.

    Raises:
        DownloadError: archive and unpacked files need more space than the disk has.
    """
    free = shutil.disk_usage(work).free
    if total is None:
        return min(_MAX_ARCHIVE, int((here + free) / (1 + _EXPANSION)))
    needed = total - here + int(_EXPANSION * total)
    if needed > free or total > _MAX_ARCHIVE:
        raise DownloadError(
            f"the disk has {free / 1e9:.1f} GB of the {needed / 1e9:.1f} GB that archive and unpacked files need.",
            file=work.parent,
            hint="free some space, or choose a folder on another disk with --out",
        )
    return total


def _digest(archive: Path, progress: Callable[[int, int], None]) -> str:
    digest, done, size = hashlib.sha256(), 0, archive.stat().st_size
    with archive.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
            done += len(chunk)
            progress(done, size)
    return digest.hexdigest()


def _check_digest(digest: str, expected: str | None, recording: PublicRecording, pin: Path) -> None:
    if expected is None or digest == expected:
        return
    hint = "repeat the command; use another mirror (--url-base) if that fails"
    if recording.sha256 is None:
        hint = f"the file changed since the first download; delete {pin} to accept the new one"
    raise ArchiveError(
        f"has the sha256 {digest}, expected is {expected}; it is removed.", file=recording.archive, hint=hint
    )


def _unpack(recording: PublicRecording, archive: Path, work: Path, progress: Callable[[int, int], None]) -> Path:
    """Unpack the archive, and return the folder of it that is kept."""
    unpacked = work / "unpacked"
    shutil.rmtree(unpacked, ignore_errors=True)
    size = archive.stat().st_size
    most = int(_MAX_EXPANSION * size) + _CHUNK

    def show(done: int) -> None:
        progress(done, max(done, int(size)))

    unpack(archive, unpacked, max_bytes=most, progress=show)
    draft = unpacked / recording.root
    if draft.is_dir():
        unpack_inner(draft, max_bytes=most, progress=show)
    if not (draft / recording.log).is_dir():
        raise ArchiveError(
            f"holds no folder {(Path(recording.root) / recording.log).as_posix()}.",
            file=archive,
            hint="the archive changed at its source; use another mirror (--url-base) or update splatbot",
        )
    return draft


def _pin(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.sha256")


def _read_pin(pin: Path) -> str | None:
    """Return the digest of an earlier download; None if there is no pin.

    Raises:
        InputError: the file holds no digest.
    """
    if not pin.exists():
        return None
    with pin.open("rb") as file:
        words = file.read(4096).split()
    if not words or not re.fullmatch(rb"[0-9a-f]{64}", words[0]):
        raise InputError("holds no sha256.", file=pin, hint="delete it, or write the output of sha256sum")
    return words[0].decode()
