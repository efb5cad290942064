"""A limit on the size of a request's body, also of one sent in chunks without a length."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from splatbot.services.problems import problem


class BodyLimit:
    """ASGI middleware that answers 413 to a body of more than ``max_bytes``.

    Args:
        larger: other bounds for paths that end so.
    """

    def __init__(self, app: ASGIApp, max_bytes: int, larger: Mapping[str, int] | None = None) -> None:
        self.app = app
        self.max_bytes = max_bytes
        self.larger = dict(larger or {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        most = next((n for end, n in self.larger.items() if scope["path"].endswith(end)), self.max_bytes)
        declared = dict(scope["headers"]).get(b"content-length", b"")
        detail = f"The body has more than {most} bytes."
        if declared.isdigit() and int(declared) > most:
            # The body is not read, so the connection cannot serve another request.
            refusal = problem(413, detail, headers={"Connection": "close"})
            await refusal(scope, receive, send)
            return
        taken = 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > most:  # raised where the application reads the body, so its handlers answer
                raise HTTPException(413, detail, headers={"Connection": "close"})
            return message

        await self.app(scope, counted, send)
