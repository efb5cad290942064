"""WebSockets: rosbridge, also at `/` where roslib clients look for it on a port of its own."""

from __future__ import annotations

from contextlib import suppress

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from splatbot.services.ros.rosbridge import RosbridgeSession
from splatbot.services.settings import ServiceSettings

router = APIRouter()


@router.websocket("/")
@router.websocket("/rosbridge")
async def rosbridge(socket: WebSocket) -> None:
    """A rosbridge v2 client, until it leaves."""
    settings: ServiceSettings = socket.app.state.settings
    await socket.accept()

    async def send(data: str | bytes) -> None:
        if isinstance(data, bytes):
            await socket.send_bytes(data)
        else:
            await socket.send_text(data)

    session = RosbridgeSession(socket.app.state.ros.graph, send, most_bytes=settings.max_message_bytes)
    try:
        with suppress(WebSocketDisconnect, RuntimeError):  # RuntimeError: sending to a client that has just gone
            while True:
                message = await socket.receive()
                if message["type"] == "websocket.disconnect":
                    break
                await session.receive(message["text"] if message.get("text") is not None else message["bytes"])
    finally:
        await session.close()
