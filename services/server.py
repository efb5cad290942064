"""Runs the application until it is told to stop."""

from __future__ import annotations

import signal
import socket
from collections.abc import Callable
from types import FrameType

import uvicorn

from splatbot.errors import InputError
from splatbot.services.app import create_app
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore


def run_service(
    settings: ServiceSettings, store: MapStore, *, on_start: Callable[[str], None] = lambda url: None
) -> None:
    """Serve ``store`` until SIGTERM or Ctrl-C; requests that are under way are answered first.

    Args:
        on_start: called with the base URL once the port is taken.

    Raises:
        InputError: the address cannot be listened on.
    """
    listener = _listen(settings.host, settings.port)
    host, port = listener.getsockname()[:2]
    on_start(f"http://{'[' + host + ']' if ':' in host else host}:{port}")
    config = uvicorn.Config(
        create_app(settings, store),
        log_level="info",
        timeout_graceful_shutdown=settings.shutdown_s,
        ws_max_size=settings.max_message_bytes,
    )
    # After its graceful end uvicorn raises the signal again for whoever else listens: here it has done its work.
    previous = {number: signal.signal(number, _ignore) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        uvicorn.Server(config).run(sockets=[listener])
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(2048)  # now, so that who connects before the application is up waits instead of being refused
    except OSError as error:
        listener.close()
        raise InputError(
            f"cannot listen on {host} port {port} ({error.strerror}).",
            field="port",
            hint="give another --host or --port",
        ) from error
    return listener


def _ignore(_number: int, _frame: FrameType | None) -> None:
    """Nothing is left to do."""
