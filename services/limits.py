"""A bound on the size of a request's body, also where it comes in chunks and tells no length."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from splatbot.services.problems import problem


class _BodyTooLargeError(Exception):
    """Carried from ``receive`` through the application to the middleware."""


class BodyLimit:
    """ASGI middleware that answers 413 to a body of more than ``max_bytes``."""

    def __init__(self, app: ASGIApp, max_bytes: int) -> None:
        self.app = app
        self.max_bytes = max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        told = dict(scope["headers"]).get(b"content-length", b"")
        if told.isdigit() and int(told) > self.max_bytes:
            await self._refuse(scope, receive, send)
            return
        taken = 0
        started = False

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > self.max_bytes:
                raise _BodyTooLargeError
            return message

        async def noted(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        try:
            await self.app(scope, counted, noted)
        except _BodyTooLargeError:
            if started:
                raise
            await self._refuse(scope, receive, send)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send) -> None:
        detail = f"The body has more than {self.max_bytes} bytes."
        # The rest of the body is not read, so the connection cannot serve another request.
        refusal = problem(
            413, detail, kind="too-large", headers={"Connection": "close"}, hint="send fewer points at once"
        )
        await refusal(scope, receive, send)
