"""One file over HTTP: resumed after interruptions, retried after passing errors, never larger than announced."""

from __future__ import annotations

import json
import re
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import httpx

from splatbot.atomic import atomic_write
from splatbot.downloads.errors import DownloadError

Room = Callable[[int | None, int], int]
"""Return the most bytes that a file may have, from its announced size and the bytes that are here [bytes].

It raises an error where the disk has too little space.
"""

_PASSING = frozenset({408, 425, 429, 500, 502, 503, 504})  # status codes that a later request may not meet
_REDIRECTS = frozenset({301, 302, 303, 307, 308})
_MAX_REDIRECTS = 5
_CONTENT_RANGE = re.compile(r"bytes (\d{1,18})-\d{1,18}/(\d{1,18})")
_MAX_STATE = 65536  # bytes of the file that describes a partial file


@dataclass(frozen=True)
class Patience:
    """Limits of waiting for a server.

    Args:
        attempts: attempts in succession that bring less than ``worth`` bytes.
        first_wait: time before the second attempt, doubled for each later one [s].
        longest_wait: longest time between two attempts, also if the server requests more [s].
        timeout: longest silence of the server [s].
        worth: bytes of an attempt after which the attempts are counted from 1 again.
    """

    attempts: int = 5
    first_wait: float = 1.0
    longest_wait: float = 60.0
    timeout: float = 30.0
    worth: int = 1 << 20


@dataclass(frozen=True)
class _Partial:
    """Identity of the file that a partial file belongs to; If-Range sends the validator (RFC 9110, 13.1.5)."""

    url: str
    validator: str
    size: int


class _PassingError(Exception):
    """An attempt failed in a way that another attempt may not."""

    def __init__(self, reason: str, wait: float = 0.0) -> None:
        super().__init__(reason)
        self.wait = wait


def fetch(
    url: str,
    target: Path,
    *,
    size: int | None,
    room: Room,
    progress: Callable[[int, int | None], None],
    notice: Callable[[str], None],
    patience: Patience,
) -> None:
    """Fetch a file; a partial file of an earlier call is continued if the server still has the same file.

    Args:
        url: address, https or http; redirects lead to https only.
        target: the file to write. The partial file is next to it, as ``NAME.part`` and ``NAME.json``.
        size: size that the file must have [bytes]. If None, any size is accepted.
        room: called with the announced size before the first byte is written.
        progress: called with the bytes that are here and the announced size [bytes].
        notice: called with a sentence before each wait.
        patience: limits of waiting.

    Raises:
        DownloadError: the server does not deliver the file.
        OSError: the disk is full or not available.
    """
    part = target.with_name(f"{target.name}.part")
    failures = 0
    with httpx.Client(timeout=patience.timeout, headers={"Accept-Encoding": "identity"}) as client:
        while True:
            before = _length(part)
            try:
                _attempt(client, url, part, size, room, progress)
                break
            except _PassingError as error:
                failures = 1 if _length(part) >= before + patience.worth else failures + 1
                if failures >= patience.attempts:
                    hint = "check the network and the proxy (HTTPS_PROXY), then repeat the command: it continues"
                    raise DownloadError(f"{error} ({failures} attempts).", file=shown(url), hint=hint) from error
                wait = min(max(patience.first_wait * 2 ** (failures - 1), error.wait), patience.longest_wait)
                notice(f"{error}; the next attempt follows in {wait:.0f} s")
                time.sleep(wait)
    part.replace(target)
    _state_file(part).unlink(missing_ok=True)


def shown(url: str) -> str:
    """Return an address without user name, password and query, which messages must not show."""
    parts = httpx.URL(url)
    return str(parts.copy_with(username=None, password=None, query=None, fragment=None))


def _attempt(
    client: httpx.Client,
    url: str,
    part: Path,
    size: int | None,
    room: Room,
    progress: Callable[[int, int | None], None],
) -> None:
    """Request the rest of the file and append it."""
    known = _read_state(part, url)
    start = _length(part) if known else 0
    if known and start == known.size:
        return
    headers = {"Range": f"bytes={start}-", "If-Range": known.validator} if known and start else {}
    with _transport_errors(url), _request(client, url, headers) as response:
        if response.status_code == 200:  # the file is new or changed, or the server knows no ranges
            start, total = 0, _announced(response) or size
        elif known and _continues(response, start, known):
            total = known.size
        else:
            _state_file(part).unlink(missing_ok=True)
            raise _PassingError("the file changed at its source, or the server sends another part of it")
        if size is not None and total != size:
            raise DownloadError(
                f"the file has {total} bytes instead of {size}.",
                file=shown(url),
                hint="the file changed at its source; check the address, or update splatbot",
            )
        most = room(total, start)
        if start == 0:
            _begin(part, url, response, total)
        _append(response, part, start, total, most, progress)


def _append(
    response: httpx.Response,
    part: Path,
    start: int,
    total: int | None,
    most: int,
    progress: Callable[[int, int | None], None],
) -> None:
    with part.open("ab") as file:
        progress(start, total)
        for chunk in response.iter_raw():
            start += len(chunk)
            if start > most:
                hint = "check the address: the server sends more than an archive of recordings"
                raise DownloadError(f"the file has more than {most} bytes.", file=shown(str(response.url)), hint=hint)
            file.write(chunk)
            progress(start, total)
    if total is not None and start != total:
        raise _PassingError(f"the server sent {start} of {total} bytes")


def _announced(response: httpx.Response) -> int | None:
    length = response.headers.get("Content-Length", "")
    return int(length) if re.fullmatch(r"\d{1,18}", length) else None


def _continues(response: httpx.Response, start: int, known: _Partial) -> bool:
    """Return whether an answer 206 is the rest of the same file; 416 is not: the file became shorter."""
    found = _CONTENT_RANGE.fullmatch(response.headers.get("Content-Range", ""))
    tag = response.headers.get("ETag", "")
    return (
        response.status_code == 206
        and found is not None
        and (int(found[1]), int(found[2])) == (start, known.size)
        and (not known.validator.startswith('"') or tag in ("", known.validator))
    )


@contextmanager
def _request(client: httpx.Client, url: str, headers: dict[str, str]) -> Iterator[httpx.Response]:
    """Send a GET, follow redirects to https, and yield an answer with a body of the file, or 416."""
    address = httpx.URL(url)
    for _ in range(_MAX_REDIRECTS + 1):
        response = client.send(client.build_request("GET", address, headers=headers), stream=True)
        try:
            if response.status_code not in _REDIRECTS:
                _check_status(response)
                yield response
                return
            address = _redirected(response)
        finally:
            response.close()
    raise DownloadError("redirects without end.", file=shown(url), hint="check the address")


def _redirected(response: httpx.Response) -> httpx.URL:
    place = response.headers.get("Location", "")
    try:
        address = response.url.join(place)
    except httpx.InvalidURL:
        address = httpx.URL("")
    if address.scheme != "https" or not address.host:
        raise DownloadError(
            f"redirects to {place[:200]!r}, which is not https.",
            file=shown(str(response.url)),
            hint="use the address of a server with https",
        )
    return address


def _check_status(response: httpx.Response) -> None:
    status = response.status_code
    if status in (200, 206, 416):
        return
    answer = f"the server answers {status} {httpx.codes.get_reason_phrase(status)}".strip()
    if status in _PASSING:
        wait = response.headers.get("Retry-After", "")
        raise _PassingError(answer, float(wait) if re.fullmatch(r"\d{1,6}", wait) else 0.0)
    hint = "check whether the file moved, and use a mirror (--url-base) or update splatbot"
    raise DownloadError(f"{answer}.", file=shown(str(response.url)), hint=hint)


@contextmanager
def _transport_errors(url: str) -> Iterator[None]:
    """Turn failures of the connection into passing errors, but those of names and certificates into lasting ones."""
    try:
        yield
    except httpx.TransportError as error:
        causes = list(_causes(error))
        host = httpx.URL(url).host
        if any(isinstance(cause, socket.gaierror) and cause.errno != socket.EAI_AGAIN for cause in causes):
            hint = "check the network, the proxy (HTTPS_PROXY) and the name of the host"
            raise DownloadError(f"the host {host!r} is not found.", file=shown(url), hint=hint) from error
        if any(isinstance(cause, ssl.SSLCertVerificationError) for cause in causes):
            hint = "check the clock of this machine, and SSL_CERT_FILE if a proxy has a certificate of its own"
            raise DownloadError(f"the certificate of {host!r} is not valid.", file=shown(url), hint=hint) from error
        raise _PassingError(f"the connection to {host!r} failed ({str(error) or type(error).__name__})") from error
    except httpx.HTTPError as error:
        raise DownloadError(f"the answer is damaged ({error}).", file=shown(url), hint="use another mirror") from error


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _length(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _state_file(part: Path) -> Path:
    return part.with_suffix(".json")


def _read_state(part: Path, url: str) -> _Partial | None:
    """Return the identity of the partial file; None if it is unknown, or of another address."""
    with suppress(OSError, ValueError, TypeError, RecursionError):
        with _state_file(part).open("rb") as file:
            state = _Partial(**json.loads(file.read(_MAX_STATE)))
        if state.url == shown(url) and isinstance(state.validator, str) and _length(part) <= state.size:
            return state
    return None


def _begin(part: Path, url: str, response: httpx.Response, total: int | None) -> None:
    """Start a partial file, and keep its identity; without a strong validator and a size it cannot be continued."""
    tag = response.headers.get("ETag", "")
    validator = tag if tag.startswith('"') else response.headers.get("Last-Modified", "")
    _state_file(part).unlink(missing_ok=True)
    part.write_bytes(b"")
    if validator and total is not None:
        with atomic_write(_state_file(part)) as file:
            file.write(json.dumps(asdict(_Partial(shown(url), validator, total))).encode())
