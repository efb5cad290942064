"""A client of viser's protocol that keeps the Gaussians as a page does: the layout of `viser.infra._infra`."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import httpx
import msgspec.msgpack
import numpy as np
import viser
import zstandard
from numpy.typing import NDArray
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from splatbot.service_key import key_file, read_key

Array = NDArray[np.float64]
WIDTH, HEIGHT, FOV = 640, 480, 1.0


class ViserClient:
    """One browser without a picture.

    Args:
        port: of the viewer.
    """

    def __init__(self, port: int) -> None:
        url = f"127.0.0.1:{port}"
        ticket = httpx.get(f"http://{url}/?key={read_key(key_file())}").headers["set-cookie"].partition(";")[0]
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        headers = {"Cookie": ticket}
        self._socket = connect(f"ws://{url}/", subprotocols=[protocol], max_size=None, additional_headers=headers)
        self.splats: dict[str, NDArray[np.uint32]] = {}
        self.gui: dict[str, dict[str, Any]] = {}
        self.nodes: set[str] = set()
        self.sent: list[str] = []
        self.most = 0

    def __enter__(self) -> ViserClient:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self._socket.close()

    def send(self, kind: str, **values: Any) -> None:
        """Send a message as a page does."""
        self._socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def look(self, position: Array, wxyz: tuple[float, float, float, float], fov: float = FOV) -> None:
        """Report a camera."""
        self.send(
            "ViewerCameraMessage",
            wxyz=list(wxyz),
            position=[float(x) for x in position],
            fov=fov,
            near=0.01,
            far=1000.0,
            image_height=HEIGHT,
            image_width=WIDTH,
            look_at=[0.0, 0.0, 0.0],
            up_direction=[0.0, 0.0, 1.0],
        )

    def set(self, label: str, value: Any) -> None:
        """Change a control."""
        uuid = next(uuid for uuid, props in self.gui.items() if props.get("label") == label)
        self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def click(self, origin: Array, direction: Array) -> None:
        """Send a click on a point of the picture."""
        self.send(
            "ScenePointerMessage",
            event_type="click",
            ray_origin=[float(x) for x in origin],
            ray_direction=[float(x) for x in direction],
            screen_pos=[[0.5, 0.5]],
            modifier=None,
        )

    def read(self, until: Callable[[], bool], timeout_s: float = 20.0) -> None:
        """Read messages until a condition holds."""
        end = time.monotonic() + timeout_s
        while not until():
            try:
                self._take(self._socket.recv(timeout=max(end - time.monotonic(), 0.0)))
            except TimeoutError as error:
                raise AssertionError(f"it never came; the page has {len(self.splats)} tiles, {self.text}") from error

    def drain(self, quiet_s: float) -> None:
        """Read messages until none has come for a time."""
        while True:
            try:
                self._take(self._socket.recv(timeout=quiet_s))
            except TimeoutError:
                return

    @property
    def text(self) -> str:
        """All texts of the panel."""
        return "\n".join(str(props.get("_markdown", "")) for props in self.gui.values())

    @property
    def centers(self) -> NDArray[np.float32]:
        """Centres (N, 3) of all Gaussians [m]: the first three words of each."""
        return np.concatenate([np.zeros((0, 8), np.uint32), *self.splats.values()])[:, :3].copy().view(np.float32)

    @property
    def colors(self) -> NDArray[np.uint8]:
        """RGB (N, 3): the first bytes of the last word of each."""
        return np.concatenate(list(self.splats.values()))[:, 7:].copy().view(np.uint8)[:, :3]

    def _take(self, data: str | bytes) -> None:
        assert isinstance(data, bytes)
        size, compressed = (int.from_bytes(data[i : i + 8], "little") for i in (0, 8))
        body = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + compressed], size))
        at, buffers = 16 + compressed, []
        for length in body["binaryBufferLengths"]:
            at += -at % 8
            buffers.append(data[at : at + length])
            at += length
        for message in body["messages"]:
            self._apply(message, buffers)

    def _apply(self, message: dict[str, Any], buffers: list[bytes]) -> None:
        kind, name = message["type"], message.get("name", "")
        if kind == "GaussianSplatsMessage":
            buffer = buffers[message["props"]["buffer"]["__binary_index"]]
            self.splats[name] = np.frombuffer(buffer, np.uint32).reshape(-1, 8)
            self.sent.append(name)
            self.most = max(self.most, sum(len(part) for part in self.splats.values()))
        elif kind == "RemoveSceneNodeMessage":
            self.splats.pop(name, None)
            self.nodes.discard(name)
        elif kind == "GuiUpdateMessage":
            self.gui[message["uuid"]].update(message["updates"])
        elif kind.startswith("Gui") and "props" in message:
            self.gui[message["uuid"]] = dict(message["props"])
        elif "props" in message and name:
            self.nodes.add(name)
