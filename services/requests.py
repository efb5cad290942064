"""Every request has an id, a line in the log and its place in the metrics."""

from __future__ import annotations

import json
import logging
import re
import secrets
import time
from contextvars import ContextVar
from typing import Protocol

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADER = "X-Request-ID"
request_id: ContextVar[str] = ContextVar("request_id", default="")

_log = logging.getLogger("splatbot.requests")
_GIVEN = re.compile(r"[A-Za-z0-9._-]{1,64}")
_SECRET = re.compile(r"spb_[\w-]+|(?<=api_key=)[^&\s\"']+")


class RequestCounter(Protocol):
    """Interface of a request counter."""

    def count(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count an answered request."""
        ...


class RequestLog:
    """ASGI middleware: takes the client's X-Request-ID or makes one, returns it, logs and counts the request."""

    def __init__(self, app: ASGIApp, counter: RequestCounter) -> None:
        self.app = app
        self._counter = counter

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        given = dict(scope["headers"]).get(HEADER.lower().encode(), b"").decode("latin-1")
        this = given if _GIVEN.fullmatch(given) else secrets.token_hex(8)
        token = request_id.set(this)
        status, begin = 500, time.perf_counter()

        async def counting_send(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)[HEADER] = this
            await send(message)

        try:
            await self.app(scope, receive, counting_send)
        finally:
            seconds = time.perf_counter() - begin
            route = scope.get("route")
            # The route's template, not the path: ids and typing errors must not make a series each.
            self._counter.count(scope["method"], getattr(route, "path", "unknown"), status, seconds)
            if status >= 500 or getattr(route, "path", "") not in ("/healthz", "/readyz", "/metrics"):
                _log.info("%s %s %d %.1f ms", scope["method"], scope["path"], status, 1e3 * seconds)
            request_id.reset(token)


def hide_keys(text: str) -> str:
    """Replace API keys by asterisks."""
    return _SECRET.sub("***", text)


def one_line(text: str) -> str:
    """Hide API keys, and escape control characters, which forge lines of a log."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in hide_keys(text))


class JsonFormatter(logging.Formatter):
    """One JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record with its time, level, logger, message and request."""
        fields = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S%z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": hide_keys(record.getMessage()),
            "request_id": request_id.get() or None,
            "error": hide_keys(self.formatException(record.exc_info)) if record.exc_info else None,
        }
        return json.dumps({name: value for name, value in fields.items() if value is not None})


class TextFormatter(logging.Formatter):
    """``LEVEL: message``, with the request where there is one; lines of a traceback are indented."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record as a line, and lines of its traceback."""
        this = request_id.get()
        line = f"{record.levelname}: {one_line(record.getMessage())}" + (f" [{this}]" if this else "")
        trace = self.formatException(record.exc_info).splitlines() if record.exc_info else []
        return "\n    ".join([line, *map(one_line, trace)])


def configure_logging(*, as_json: bool) -> None:
    """Log to stderr, from INFO on."""
    handler = logging.StreamHandler()
    handler.setFormatter(JsonFormatter() if as_json else TextFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
