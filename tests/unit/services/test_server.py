"""The sockets that the service listens on."""

from __future__ import annotations

import asyncio
import socket

import pytest

from splatbot.errors import InputError
from splatbot.services.connections import Connections, listen

CONNECTIONS = Connections(8, 8, 10.0, 30.0)


def test_answers_do_not_wait_for_the_clients_acknowledgement() -> None:
    """asyncio turns Nagle's algorithm off only where the listening socket says that it is TCP."""

    async def option() -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            line = writer.get_extra_info("socket")
            found.set_result(line.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        listener = listen("127.0.0.1", 0, CONNECTIONS)
        async with await asyncio.start_server(serve, sock=listener):
            _, writer = await asyncio.open_connection(*listener.getsockname())
            value = await asyncio.wait_for(found, 10)
            writer.close()
        return value

    assert asyncio.run(option()) != 0


def test_a_taken_port_is_named_with_the_way_out() -> None:
    with listen("127.0.0.1", 0, CONNECTIONS) as taken, pytest.raises(InputError, match="cannot listen"):
        listen("127.0.0.1", taken.getsockname()[1], CONNECTIONS)
