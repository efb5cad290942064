"""An HTTP server that answers chat completions: well, wrongly, slowly or with ill will."""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Pictures = list[NDArray[np.uint8]]
Behaviour = Callable[[BaseHTTPRequestHandler, dict[str, Any]], None]


@dataclass
class FakeEndpoint:
    """Recorded requests and the behaviour of the endpoint, which tests may replace at any time."""

    behave: Behaviour
    url: str = ""
    requests: list[dict[str, Any]] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    over: threading.Event = field(default_factory=threading.Event)  # ends slow answers


@contextmanager
def serve(behave: Behaviour) -> Iterator[FakeEndpoint]:
    endpoint = FakeEndpoint(behave)

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            endpoint.requests.append(body)
            endpoint.headers.append(dict(self.headers))
            with suppress(BrokenPipeError, ConnectionResetError):
                endpoint.behave(self, body)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    endpoint.url = f"http://127.0.0.1:{server.server_port}/v1"
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield endpoint
    finally:
        endpoint.over.set()
        server.shutdown()
        thread.join()
        server.server_close()


def pictures_of(body: dict[str, Any]) -> Pictures:
    """Decode the RGB images of a request."""
    urls = [part["image_url"]["url"] for part in body["messages"][1]["content"] if part["type"] == "image_url"]
    data = [np.frombuffer(base64.b64decode(url.split(",", 1)[1]), np.uint8) for url in urls]
    return [cv2.cvtColor(cv2.imdecode(one, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB).astype(np.uint8) for one in data]  # type: ignore[arg-type]


def send(handler: BaseHTTPRequestHandler, data: bytes, status: int = 200, **headers: str) -> None:
    handler.send_response(status)
    for name, value in {"Content-Length": str(len(data)), **headers}.items():
        handler.send_header(name, value)
    handler.end_headers()
    handler.wfile.write(data)


def say(text: str) -> Behaviour:
    """Answer every request with a chat completion of this content."""
    data = json.dumps({"choices": [{"message": {"role": "assistant", "content": text}}]}).encode()
    return lambda handler, body: send(handler, data)


def point_with(find: Callable[[Pictures], list[dict[str, Any]]]) -> Behaviour:
    """Answer each request with the result of ``find`` on its images."""

    def behave(handler: BaseHTTPRequestHandler, body: dict[str, Any]) -> None:
        say(json.dumps({"answers": find(pictures_of(body))}))(handler, body)

    return behave


def by_color(rgb: tuple[float, float, float], confidence: float = 0.9) -> Callable[[Pictures], list[dict[str, Any]]]:
    """Return a small vision model: it finds the centre of a colour in each image with at least 50 such pixels."""

    def find(pictures: Pictures) -> list[dict[str, Any]]:
        answers = []
        for k, picture in enumerate(pictures):
            v, u = np.nonzero(np.abs(picture / 255.0 - np.array(rgb)).max(axis=-1) < 0.2)
            if len(u) >= 50:
                m = int(np.argmin(np.hypot(u - np.median(u), v - np.median(v))))
                answers.append(answer(k, float(u[m]), float(v[m]), confidence))
        return answers

    return find


def answer(view: int, u: float, v: float, confidence: float = 0.9) -> dict[str, Any]:
    return {"view": view, "u": u, "v": v, "label": "object", "confidence": confidence}


def drip(endpoint_over: Callable[[], threading.Event], part: bytes, every: float = 0.02) -> Behaviour:
    """Send one byte every ``every`` seconds without end."""

    def behave(handler: BaseHTTPRequestHandler, body: dict[str, Any]) -> None:
        handler.wfile.write(part)
        while not endpoint_over().wait(every):
            handler.wfile.write(b"x")
            handler.wfile.flush()

    return behave
