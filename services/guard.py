"""Access control: API keys, request rate and concurrency, as ASGI middleware for HTTP and WebSockets."""

from __future__ import annotations

import time
from collections import OrderedDict
from urllib.parse import parse_qs

from starlette.types import ASGIApp, Receive, Scope, Send

from splatbot.services.keys import known_key
from splatbot.services.problems import problem
from splatbot.services.settings import ServiceSettings

OPEN = frozenset({"/healthz", "/readyz"})  # for probes: they reveal only versions, and must answer under load
_CLIENTS = 10_000  # whose rates are remembered
_BURST_S = 2.0  # of requests at the full rate that may come at once


class Guard:
    """Refuses strangers (401), the hasty (429) and the one too many (503).

    A key comes as ``Authorization: Bearer KEY`` or ``X-API-Key: KEY``; for WebSockets, whose browser clients cannot set
    headers, also as ``?api_key=KEY``. Event streams are counted by themselves, for they last.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self.app = app
        self._settings = settings
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._running = {"requests": 0, "streams": 0}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request or WebSocket."""
        if scope["type"] == "lifespan" or scope["path"] in OPEN:
            await self.app(scope, receive, send)
            return
        client = self._client(scope)
        if client is None:
            hint = "send Authorization: Bearer KEY"
            await _refuse(scope, receive, send, 401, "A valid API key is needed.", hint, {"WWW-Authenticate": "Bearer"})
            return
        scope.setdefault("state", {}).update(client=client, scopes=frozenset({"read", "map", "move", "admin"}))
        wait = self._wait(client)
        if wait > 0:
            detail = f"More than {self._settings.requests_per_s:g} requests a second."
            header = {"Retry-After": str(int(wait) + 1)}
            await _refuse(scope, receive, send, 429, detail, "ask less often, or for more at once", header)
            return
        lasts = scope["type"] == "websocket" or scope["path"].endswith("/events")
        kind, most = ("streams", self._settings.max_streams) if lasts else ("requests", self._settings.max_requests)
        if self._running[kind] >= most:
            await _refuse(scope, receive, send, 503, f"{most} {kind} are open.", "try again", {"Retry-After": "1"})
            return
        self._running[kind] += 1
        try:
            await self.app(scope, receive, send)
        finally:
            self._running[kind] -= 1

    def _client(self, scope: Scope) -> str | None:
        """Return the client's identity for rate limits, or None without a valid key."""
        if not self._settings.api_keys:
            return str((scope.get("client") or ("local",))[0])
        headers = {name: value.decode("latin-1") for name, value in scope["headers"]}
        kind, _, token = headers.get(b"authorization", "").partition(" ")
        key = token.strip() if kind.lower() == "bearer" else headers.get(b"x-api-key", "")
        if not key and scope["type"] == "websocket":
            key = parse_qs(scope["query_string"].decode("latin-1")).get("api_key", [""])[0]
        return known_key(key, self._settings.api_keys)

    def _wait(self, client: str) -> float:
        """Return the time [s] that the client must wait, 0 if it need not (token bucket)."""
        rate = self._settings.requests_per_s
        now = time.monotonic()
        level, then = self._buckets.pop(client, (rate * _BURST_S, now))
        level = min(rate * _BURST_S, level + (now - then) * rate)
        allowed = level >= 1.0
        self._buckets[client] = (level - 1.0 if allowed else level, now)
        if len(self._buckets) > _CLIENTS:
            self._buckets.popitem(last=False)
        return 0.0 if allowed else (1.0 - level) / rate


async def _refuse(
    scope: Scope, receive: Receive, send: Send, status: int, detail: str, hint: str, headers: dict[str, str]
) -> None:
    if scope["type"] == "websocket":
        await receive()  # the handshake; closing before accepting it answers 403
        await send({"type": "websocket.close", "code": 1008, "reason": detail})
        return
    await problem(status, detail, headers={"Connection": "close"} | headers, hint=hint)(scope, receive, send)
