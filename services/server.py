"""Runs the application until it receives a signal to stop."""

from __future__ import annotations

import logging
import signal
import socket
from collections.abc import Callable
from functools import partial
from types import FrameType

import uvicorn
from fastapi import FastAPI

from splatbot.logs.ros_types import typestore
from splatbot.services.app import create_app
from splatbot.services.connections import Connections, HttpProtocol, listen, raise_file_limit
from splatbot.services.heap import freeze_imports
from splatbot.services.runtime import Runtime, check_exposure
from splatbot.services.settings import ServiceSettings

_log = logging.getLogger(__name__)


class Server(uvicorn.Server):
    """uvicorn's server, which bounds its connections and notifies the runtime of the end.

    Event streams then end before uvicorn waits for them.

    Args:
        runtime: of the application.
        app: made by :func:`splatbot.services.app.create_app`.
        addresses: hosts and ports to listen on.

    Raises:
        InputError: an address cannot be listened on.
    """

    def __init__(self, runtime: Runtime, app: FastAPI, addresses: list[tuple[str, int]]) -> None:
        settings = runtime.settings
        # Half of the files are for maps, logs and clients of the integrations.
        files = raise_file_limit(2 * settings.max_connections) // 2
        self.connections = Connections(
            min(settings.max_connections, files),
            min(settings.max_client_connections, files // 2),
            settings.idle_s,
            settings.body_s,
        )
        self.listeners = [listen(host, port, self.connections) for host, port in addresses]
        self._runtime = runtime
        config = server_config(app, settings)
        config.http = partial(HttpProtocol, connections=self.connections)  # type: ignore[assignment]
        super().__init__(config)

    async def on_tick(self, counter: int) -> bool:
        """Close silent connections ten times a second."""
        self.connections.close_silent()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the event streams, then everything else."""
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
    addresses = [(settings.host, port) for port in (settings.port, settings.ros_port) if port is not None]
    server = Server(runtime, create_app(runtime), addresses)
    host, port = server.listeners[0].getsockname()[:2]
    scheme = "https" if settings.tls_cert is not None else "http"
    on_start(f"{scheme}://{'[' + host + ']' if ':' in host else host}:{port}")

    def end(_number: int, _frame: FrameType | None) -> None:
        """End a server that has not installed its own handlers yet; after its end this has no further effect."""
        server.should_exit = True

    warm_process()
    previous = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        server.run(sockets=list(server.listeners))
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def warm_process() -> None:
    """Prepare a process before it serves, so that this work does not hold up its event loop later."""
    typestore()  # takes 70 ms, at the first ROS message otherwise
    freeze_imports()


def server_config(app: FastAPI, settings: ServiceSettings) -> uvicorn.Config:
    """Configure uvicorn."""
    return uvicorn.Config(
        app,
        log_config=None,  # the process' own, see splatbot.services.requests
        access_log=False,  # the application's names the request's id, and no query
        timeout_graceful_shutdown=settings.shutdown_s,
        ws_max_size=settings.max_message_bytes,
        ws_per_message_deflate=False,  # a few kB inflate on the event loop to the largest message
        ssl_certfile=settings.tls_cert,
        ssl_keyfile=settings.tls_key,
        server_header=False,
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
        loop="asyncio",  # uvloop does not ask the listener
    )
