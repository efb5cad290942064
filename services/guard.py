"""Access control for HTTP and WebSockets: names, origins, API keys, request rate and concurrency."""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Mapping
from types import MappingProxyType
from urllib.parse import parse_qsl, urlencode

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from splatbot.services.access import Access
from splatbot.services.codecs import JSON, MSGPACK, NPY, ZIP
from splatbot.services.problems import problem
from splatbot.services.queues import URGENT, lasts
from splatbot.services.scopes import listed_scope, scope_error
from splatbot.services.settings import ServiceSettings

OPEN = frozenset({"/healthz", "/readyz"})  # for probes: they reveal only versions, and must answer under load
BODIES = (JSON, MSGPACK, NPY, ZIP)  # pages of other sites send none of these without a preflight request
_CLIENTS = 10_000  # whose rates are remembered
_BURST_S = 2.0  # of requests at the full rate that may come at once


class Guard:
    """Refuses foreign names (421) and pages (403), strangers (401), the hasty (429) and the one too many (503).

    A key comes as ``Authorization: Bearer KEY`` or ``X-API-Key: KEY``; for WebSockets, whose browser clients cannot set
    headers, also as ``?api_key=KEY``. Event streams are counted by themselves, for they last.

    Requests that pass have ``client``, ``scopes`` and ``has_key`` in ``scope["state"]``.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings, access: Access) -> None:
        self.app = app
        self._settings, self._access = settings, access
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._open: Counter[tuple[str, str]] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request or WebSocket."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        key = _take_key(scope)
        if (refusal := self._foreign(scope)) is not None:
            await _refuse(scope, receive, send, *refusal)
            return
        if scope["path"] in OPEN:
            scope.setdefault("state", {}).update(client="", scopes=frozenset({"read"}), has_key=False)
            await self.app(scope, receive, send)
            return
        grant = self._access.grant(key, str((scope.get("client") or ("local",))[0]))
        if grant is None:
            hint = self._access.key_hint
            await _refuse(scope, receive, send, 401, "A valid API key is needed.", hint, {"WWW-Authenticate": "Bearer"})
            return
        scope.setdefault("state", {}).update(client=grant.client, scopes=grant.scopes, has_key=bool(key))
        need = listed_scope(scope["method"], scope["path"]) if scope["type"] == "http" else None
        if need is not None and need not in grant.scopes:  # before the body is read
            error = scope_error(need, bool(key))
            await _refuse(scope, receive, send, error.http_status, error.message, error.hint or "")
            return
        if scope["path"] in URGENT:
            await self.app(scope, receive, send)
            return
        wait = self._wait(grant.client)
        if wait > 0:
            detail = f"More than {self._settings.requests_per_s:g} requests a second."
            header = {"Retry-After": str(int(wait) + 1)}
            await _refuse(scope, receive, send, 429, detail, "ask less often, or for more at once", header)
            return
        await self._count(grant.client, scope, receive, send)

    async def _count(self, client: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request or WebSocket unless too many are open."""
        bounds = {("requests", ""): self._settings.max_requests}
        if lasts(scope):
            bounds = {
                ("streams", ""): self._settings.max_streams,
                ("streams", client): self._settings.max_client_streams,
            }
        for counted, most in bounds.items():
            if self._open[counted] >= most:
                detail = f"{most} {counted[0]} {'of this client ' if counted[1] else ''}are open."
                await _refuse(scope, receive, send, 503, detail, "try again", {"Retry-After": "1"})
                return
        self._open.update(bounds.keys())
        try:
            await self.app(scope, receive, send)
        finally:
            self._open -= Counter(bounds.keys())

    def _foreign(self, scope: Scope) -> tuple[int, str, str] | None:
        """Return status, detail and hint for a request that is malformed or of another site, else None."""
        headers = Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or len(origins) > 1:
            return 400, f"There are {len(hosts)} Host and {len(origins)} Origin headers.", "send one Host"
        if "content-length" in headers and "transfer-encoding" in headers:
            return 400, "Content-Length and Transfer-Encoding are both given.", "send one of the two"
        if not self._access.host_allowed(hosts[0]):
            hint = "use the address of the service, or add the name to SPLATBOT_ALLOWED_HOSTS"
            return 421, f"{hosts[0][:80]!r} is no name of this service.", hint
        origin = origins[0] if origins else None
        simple = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        if not simple and not self._access.origin_allowed(origin, scope["scheme"], hosts[0]):
            hint = "open the page from the service itself, or add its origin to SPLATBOT_CORS_ORIGINS"
            return 403, f"Pages of {str(origin)[:80]!r} may not ask.", hint
        body = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if body and kind not in BODIES:
            detail = f"The body is {kind[:80]!r}; taken are {', '.join(BODIES)}."
            return 415, detail, "name the Content-Type of the body"
        return None

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


def _take_key(scope: Scope) -> str:
    """Return the key that a request presents, empty without one, and remove it from the query, which others log."""
    headers = Headers(scope=scope)
    kind, _, token = headers.get("authorization", "").partition(" ")
    key = token.strip() if kind.lower() == "bearer" else headers.get("x-api-key", "")
    if b"api_key" in scope["query_string"]:
        query = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        scope["query_string"] = urlencode([(name, value) for name, value in query if name != "api_key"]).encode()
        if not key and scope["type"] == "websocket":
            key = dict(reversed(query)).get("api_key", "")
    return key


async def _refuse(
    scope: Scope,
    receive: Receive,
    send: Send,
    status: int,
    detail: str,
    hint: str,
    headers: Mapping[str, str] = MappingProxyType({}),
) -> None:
    if scope["type"] == "websocket":
        await receive()  # the handshake; closing before accepting it answers 403
        if "websocket.http.response" not in scope.get("extensions", {}):
            await send({"type": "websocket.close", "code": 1008, "reason": detail})
            return
        status = 403 if status == 401 else status
    await problem(status, detail, headers={"Connection": "close", **headers}, hint=hint)(scope, receive, send)
