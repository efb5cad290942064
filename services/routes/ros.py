"""WebSockets: rosbridge, also at `/` where roslib clients look for it on a port of its own, and Foxglove."""

from __future__ import annotations

from contextlib import suppress
from typing import Protocol

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from splatbot.services.ros.foxglove import SUBPROTOCOLS, FoxgloveSession
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.rosbridge import RosbridgeSession

router = APIRouter()


class _Session(Protocol):
    async def receive(self, text: str | bytes) -> None: ...

    async def close(self) -> None: ...


@router.websocket("/")
@router.websocket("/rosbridge")
async def rosbridge(socket: WebSocket) -> None:
    """Serve a rosbridge v2 client until it leaves."""
    await socket.accept()
    wire = _Wire(socket)
    scopes = socket.state.scopes
    await wire.serve(RosbridgeSession(wire.graph, wire.send, most_bytes=wire.most_bytes, scopes=scopes))


@router.websocket("/foxglove")
async def foxglove(socket: WebSocket) -> None:
    """Serve a Foxglove client until it leaves; a client without its protocols is refused."""
    offered = socket.scope.get("subprotocols", [])
    known = next((name for name in SUBPROTOCOLS if name in offered), None)
    if known is None:
        await socket.close(reason=f"offer the subprotocol {SUBPROTOCOLS[0]}")
        return
    await socket.accept(subprotocol=known)
    wire = _Wire(socket)
    session = FoxgloveSession(wire.graph, wire.send, most_bytes=wire.most_bytes)
    with suppress(WebSocketDisconnect, RuntimeError):
        await session.open()
    await wire.serve(session)


class _Wire:
    """A WebSocket as sessions see it."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self.graph: RosGraph = socket.app.state.ros.graph
        self.most_bytes: int = socket.app.state.runtime.settings.max_message_bytes

    async def send(self, data: str | bytes) -> None:
        """Send text as text, bytes as binary."""
        await (self._socket.send_bytes(data) if isinstance(data, bytes) else self._socket.send_text(data))

    async def serve(self, session: _Session) -> None:
        """Pass the client's messages to the session until it leaves."""
        try:
            with suppress(WebSocketDisconnect, RuntimeError):  # RuntimeError: the client has just left
                while (message := await self._socket.receive())["type"] != "websocket.disconnect":
                    text = message.get("text")
                    await session.receive(text if text is not None else message["bytes"])
        finally:
            await session.close()
