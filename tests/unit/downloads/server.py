"""A local HTTP server of files that misbehaves on request, and small recordings for it."""

from __future__ import annotations

import hashlib
import io
import re
import ssl
import tarfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

Answer = Callable[["Handler"], None]


class FileServer(ThreadingHTTPServer):
    """Serves ``files`` by path; each answer of ``answers`` replaces one request's, the first one first."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.answers: list[Answer] = []
        self.requests: list[tuple[str, Mapping[str, str]]] = []
        self.scheme = "http"

    @property
    def base(self) -> str:
        """The address of the server."""
        return f"{self.scheme}://127.0.0.1:{self.server_address[1]}"

    @property
    def ranges(self) -> list[str | None]:
        """The Range of each request."""
        return [headers.get("Range") for _, headers in self.requests]

    def add(self, path: str, content: bytes) -> str:
        """Serve a file, and return its address."""
        self.files[path] = content
        return self.base + path

    def encrypt(self, certificate: Path) -> None:
        """Use TLS with a PEM file that holds the key and the certificate."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate)
        self.socket = context.wrap_socket(self.socket, server_side=True)
        self.scheme = "https"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore clients that leave early."""


class Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    server: FileServer

    def do_GET(self) -> None:
        self.server.requests.append((self.path, dict(self.headers)))
        answer = self.server.answers.pop(0) if self.server.answers else send
        answer(self)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    def start(self, status: int, **headers: object) -> None:
        """Send status and headers; underscores of names become hyphens."""
        self.send_response(status)
        for name, value in headers.items():
            if value is not None:
                self.send_header(name.replace("_", "-"), str(value))
        self.end_headers()


def send(
    handler: Handler,
    *,
    ranges: bool = True,
    conditions: bool = True,
    validator: bool = True,
    cut: int | None = None,
    announced: int | None = None,
    pause_s: float = 0.0,
) -> None:
    """Send a file, or its requested end.

    Args:
        handler: of the request.
        ranges: obey Range.
        conditions: obey If-Range.
        validator: send an ETag.
        cut: number of bytes after which the connection closes.
        announced: Content-Length instead of the true one.
        pause_s: time between two pieces of 16 KiB [s].
    """
    content = handler.server.files.get(handler.path)
    if content is None:
        handler.start(404, Content_Length=0)
        return
    tag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
    wanted = re.fullmatch(r"bytes=(\d+)-", handler.headers.get("Range", ""))
    same = handler.headers.get("If-Range") == tag or not conditions
    first = int(wanted[1]) if wanted and ranges and same else 0
    common = {"ETag": tag if validator else None, "Content_Length": announced or len(content) - first}
    if first >= len(content) > 0:
        handler.start(416, Content_Range=f"bytes */{len(content)}", Content_Length=0)
        return
    if first:
        handler.start(206, Content_Range=f"bytes {first}-{len(content) - 1}/{len(content)}", **common)
    else:
        handler.start(200, **common)
    body = content[first:][:cut]
    for place in range(0, len(body), 1 << 14):
        handler.wfile.write(body[place : place + (1 << 14)])
        if pause_s:
            time.sleep(pause_s)


def refuse(status: int, **headers: object) -> Answer:
    """Return an answer without a body."""
    return lambda handler: handler.start(status, Content_Length=0, **headers)


def endless(handler: Handler) -> None:
    """Send bytes without end, and without a Content-Length."""
    handler.start(200)
    while True:
        handler.wfile.write(bytes(1 << 16))


def cut(after: int) -> Answer:
    """Return an answer that ends after a number of bytes."""
    return partial(send, cut=after)


@contextmanager
def serving() -> Iterator[FileServer]:
    """Run a server in a thread."""
    server = FileServer()
    thread = threading.Thread(target=lambda: server.serve_forever(poll_interval=0.02), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def tgz(folder: Path, root: str) -> bytes:
    """Pack a folder as .tar.gz."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as tar:
        tar.add(folder, arcname=root)
    return packed.getvalue()


def zipped(files: Mapping[str, bytes]) -> bytes:
    """Pack files by name as .zip."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as pack:
        for name, content in files.items():
            pack.writestr(name, content)
    return packed.getvalue()
