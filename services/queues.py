"""Queues of work by kind: no kind waits for another one, and health, metrics and the stop wait for none."""

from __future__ import annotations

import os
import re
from collections import Counter
from contextlib import AbstractAsyncContextManager
from types import TracebackType

import anyio
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from splatbot.services.problems import problem

URGENT = frozenset({"/healthz", "/readyz", "/metrics", "/v1/stop"})
"""Paths that are answered on the event loop, or in a thread of their own."""

_SHARE = max(1, (os.cpu_count() or 1) // 2)  # of the cores, for kinds whose requests compute for long

AT_ONCE = {
    "motions": 4,
    "plans": max(2, _SHARE),  # a long plan leaves a place for a short one
    "views": _SHARE,
    "exports": _SHARE,
    "queries": max(2, _SHARE),
    "frames": 8,
    "uploads": 4,
    "versions": 2,
    "others": 4,
}
"""Requests of each kind that are worked on at once. More than the cores would only slow down mapping."""

THREADS = sum(AT_ONCE.values()) + 24
"""Threads that answer: no kind can take the last one."""

_KINDS = {
    "motions": re.compile(r"/v1/(trajectories|arms|leases)(/.*)?"),
    "plans": re.compile(r".*/(plans|grasps)|/v1/ik"),
    "views": re.compile(r".*/(render|views)"),
    "exports": re.compile(r".*/splats\..*"),
    "queries": re.compile(r".*/(distance|collisions)"),
    "frames": re.compile(r".*/frames"),
    "uploads": re.compile(r".*/upload"),
    "versions": re.compile(r".*/versions(/.*)?"),
}


def lasts(scope: Scope) -> bool:
    """Return whether a connection is a stream: a WebSocket or server-sent events."""
    return scope["type"] == "websocket" or str(scope["path"]).endswith("/events")


def kind_of(path: str) -> str:
    """Return the kind of work of a path."""
    return next((kind for kind, pattern in _KINDS.items() if pattern.fullmatch(path)), "others")


class Queues:
    """ASGI middleware that lets a few requests of each kind work at once.

    The others wait. A request beyond the queue is answered 503. A request takes its place once its body has arrived,
    and leaves its queue when its client leaves. It returns its place before the answer is sent, so that slow clients
    hold no place. An export returns it afterwards: until then its file is on the disk.

    Args:
        most_waiting: requests of one kind that may wait.
        body_s: time within which the body must arrive [s]; for uploads, each part of it.
    """

    def __init__(self, app: ASGIApp, most_waiting: int, body_s: float) -> None:
        self.app = app
        self._most_waiting, self._body_s = most_waiting, body_s
        self._places = {kind: anyio.Semaphore(number) for kind, number in AT_ONCE.items()}
        self._waiting: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["path"] in URGENT or lasts(scope):
            await self.app(scope, receive, send)
            return
        kind, body = kind_of(scope["path"]), None
        if kind == "uploads":
            receive = self._in_time(receive)
        else:
            try:
                body = await self._body(receive)
            except HTTPException as error:
                await problem(error.status_code, error.detail, headers=error.headers)(scope, receive, send)
                return
            if body is None:
                return  # the client is gone
        if self._places[kind].value == 0 and self._waiting[kind] >= self._most_waiting:
            detail = f"{self._most_waiting} requests of the kind {kind!r} wait."
            hint = "ask again later, or raise SPLATBOT_MAX_WAITING"
            await problem(503, detail, headers={"Retry-After": "1"}, hint=hint)(scope, receive, send)
            return
        if not await self._take_place(kind, receive if kind != "uploads" else None):
            return  # the client has left the queue
        if body is not None:
            receive = _again(body, receive)
        async with _Place(self._places[kind]) as place:

            async def freeing_send(message: Message) -> None:
                if message["type"] == "http.response.start" and kind != "exports":
                    place.leave()
                await send(message)

            await self.app(scope, receive, freeing_send)

    async def _take_place(self, kind: str, receive: Receive | None) -> bool:
        """Wait for a place of a kind; returns False if the client leaves first."""
        places, taken = self._places[kind], False
        if places.value > 0 or receive is None:
            await places.acquire()
            return True
        self._waiting[kind] += 1
        try:
            async with anyio.create_task_group() as group:

                async def watch() -> None:
                    while (await receive())["type"] != "http.disconnect":
                        pass
                    group.cancel_scope.cancel()

                group.start_soon(watch)
                await places.acquire()
                taken = True
                group.cancel_scope.cancel()
        finally:
            self._waiting[kind] -= 1
        return taken

    async def _body(self, receive: Receive) -> bytes | None:
        """Return the whole body, or None if the client leaves."""
        parts, more = [], True
        with anyio.move_on_after(self._body_s) as limit:
            while more:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return None
                parts.append(message.get("body", b""))
                more = message.get("more_body", False)
        if limit.cancelled_caught:
            raise self._too_slow()
        return b"".join(parts)

    def _in_time(self, receive: Receive) -> Receive:
        async def part() -> Message:
            with anyio.move_on_after(self._body_s):
                return await receive()
            raise self._too_slow()

        return part

    def _too_slow(self) -> HTTPException:
        return HTTPException(408, f"The body did not come within {self._body_s:g} s.", {"Connection": "close"})


class _Place(AbstractAsyncContextManager["_Place"]):
    """A place that is taken; it is left once."""

    def __init__(self, places: anyio.Semaphore) -> None:
        self._places: anyio.Semaphore | None = places

    def leave(self) -> None:
        """Let the next one have the place."""
        if self._places is not None:
            self._places.release()
            self._places = None

    async def __aenter__(self) -> _Place:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.leave()


def _again(body: bytes, receive: Receive) -> Receive:
    """Return a ``receive`` that returns a body that was read before, then the later messages."""
    given = False

    async def first() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return first
