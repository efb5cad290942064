"""Several services on one folder of tiles: equal answers, and no service writes into it."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.robots.panda import panda
from splatbot.tiles import write_tiles
from tests.e2e.test_serve_cli import serving
from tests.unit.tiles.maps import building

CAMERA = {"fx": 90.0, "fy": 90.0, "cx": 47.5, "cy": 31.5, "width": 96, "height": 64}
POSE = {"translation": [6.0, 5.0, 1.5], "quaternion_wxyz": [0.7, -0.7, 0.0, 0.0]}
BASE = {"translation": [6.3, 6.1, 0.4], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}


def state_of(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """Return inode, time of the last change and bytes of each file."""
    found = {}
    for path in folder.iterdir():
        status = path.stat()
        found[path.name] = status.st_ino, status.st_mtime_ns, path.read_bytes()
    return found


def modes_of(pid: int, file: Path) -> set[int]:
    """Return the access modes with which a process has opened a file."""
    modes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        if os.path.realpath(link) == str(file.resolve()):
            lines = (Path(f"/proc/{pid}/fdinfo") / link.name).read_text().splitlines()
            flags = next(line.split()[1] for line in lines if line.startswith("flags:"))
            modes.add(int(flags, 8) & os.O_ACCMODE)
    return modes


@pytest.mark.long
def test_two_services_of_one_folder_answer_alike_and_write_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "tiles"
    write_tiles(building(20_000), folder, tile_gaussians=1000)
    before = state_of(folder)
    points = np.random.default_rng(0).uniform((5.5, 5.5, 0.0), (6.5, 6.5, 0.5), (50, 3)).tolist()
    requests: list[tuple[str, dict[str, Any]]] = [
        ("distance", {"points": points}),
        ("collisions", {"q": [panda().home.tolist()], "base": BASE, "gradient": True}),
        ("render", {"camera": CAMERA, "mode": "rgb", **POSE}),
    ]
    with ExitStack() as stack:
        services = [stack.enter_context(serving("--map", str(folder))) for _ in range(2)]
        for path, body in requests:
            first, second = (client.post(f"/v1/maps/default/{path}", json=body) for _, client in services)
            assert first.status_code == second.status_code == 200, first.text
            assert first.content == second.content, path
        for process, _ in services:
            assert modes_of(process.pid, folder / "tiles.bin") == {os.O_RDONLY}
    assert state_of(folder) == before
