"""Runs the application until it receives a signal to stop."""

from __future__ import annotations

import logging
import signal
import socket
from collections.abc import Callable
from types import FrameType

import uvicorn
from fastapi import FastAPI

from splatbot.errors import InputError
from splatbot.services.app import create_app
from splatbot.services.runtime import Runtime, check_exposure
from splatbot.services.settings import ServiceSettings

_log = logging.getLogger(__name__)


class _Server(uvicorn.Server):
    """Notifies the runtime of the end, so that event streams end before uvicorn waits for them."""

    def __init__(self, config: uvicorn.Config, runtime: Runtime) -> None:
        super().__init__(config)
        self._runtime = runtime

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._runtime.drain()
        await super().shutdown(sockets)


def run_service(runtime: Runtime, *, on_start: Callable[[str], None] = lambda url: None) -> None:
    """Serve until SIGTERM or Ctrl-C; requests that are under way are answered first, and maps saved.

    Args:
        on_start: called with the base URL once the port is taken.

    Raises:
        InputError: the address cannot be listened on.
        ConfigError: others could ask without a key, or TLS is not whole.
    """
    settings = runtime.settings
    check_exposure(settings)
    if settings.insecure_no_auth:
        _log.warning("insecure_no_auth: every process on this machine may map, move and delete without a key")
    config = server_config(create_app(runtime), settings)
    listeners = [listen(settings.host, settings.port)]
    if settings.ros_port is not None:
        listeners.append(listen(settings.host, settings.ros_port))
    host, port = listeners[0].getsockname()[:2]
    scheme = "https" if settings.tls_cert is not None else "http"
    on_start(f"{scheme}://{'[' + host + ']' if ':' in host else host}:{port}")
    # After its graceful end uvicorn raises the signal again for other handlers; here it has no further effect.
    previous = {number: signal.signal(number, _ignore) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        _Server(config, runtime).run(sockets=listeners)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def server_config(app: FastAPI, settings: ServiceSettings) -> uvicorn.Config:
    """Configure uvicorn."""
    return uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,  # the process' own, see splatbot.services.requests
        access_log=False,  # the application's names the request's id, and no query
        timeout_graceful_shutdown=settings.shutdown_s,
        ws_max_size=settings.max_message_bytes,
        ssl_certfile=settings.tls_cert,
        ssl_keyfile=settings.tls_key,
        server_header=False,
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
    )


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket.

    Raises:
        InputError: the address cannot be listened on.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Named as TCP, else asyncio leaves Nagle's algorithm on and each answer waits 40 ms for the client's ACK.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(2048)  # now, so that early clients wait for the application instead of being refused
    except OSError as error:
        listener.close()
        raise InputError(
            f"cannot listen on {host} port {port} ({error.strerror}).",
            field="port",
            hint="give another --host or --port",
        ) from error
    return listener


def _ignore(_number: int, _frame: FrameType | None) -> None:
    """Ignore a signal: the service has already ended."""
