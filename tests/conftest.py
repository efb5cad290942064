"""Fixtures for all tests: the folder of the real recordings, and small logs that tests damage."""

from __future__ import annotations

import json
import logging
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

WIDTH, HEIGHT, DEPTH_SCALE = 64, 48, 5000.0
INTRINSICS = {"fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5, "width": WIDTH, "height": HEIGHT, "depth_scale": 5000}

os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", "300")  # [ms], read when depthai is imported: there is no device

MakeLog = Callable[..., Path]


@pytest.fixture(autouse=True)
def logging_as_it_was() -> Iterator[None]:
    """Restores the log handlers: `serve` logs to a stderr that is closed after its test."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.fixture
def one_torch_thread() -> Iterator[None]:
    """Runs torch on one thread: more would wait for each other on small tensors, and take cores from the kernels."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def default_kernels() -> Iterator[None]:
    """Restores the threads and the instruction set of the native kernels."""
    from splatbot.rasterize.native import native

    yield
    native().set_num_threads(0)
    native().set_isa("")


@pytest.fixture(autouse=True, scope="session")
def programs_obey_ctrl_c() -> Iterator[None]:
    """Lets Ctrl-C reach the programs that tests start: a shell in the background has them ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True, scope="session")
def service_key_of_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keeps the service's key in a folder of the tests, which commands of tests inherit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        patch.delenv("SPLATBOT_API_KEY", raising=False)
        yield


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the real recordings: SPLATBOT_TEST_DATA, else shared/data next to the repository."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    root = Path(os.environ.get("SPLATBOT_TEST_DATA") or default)
    if not root.is_dir():
        reason = f"no real data at {root}; set SPLATBOT_TEST_DATA to its folder"
        if os.environ.get("CI", "").lower() in ("1", "true"):
            pytest.fail(f"CI=true, but {reason}")
        pytest.skip(reason)
    return root


@pytest.fixture
def make_log(tmp_path: Path) -> MakeLog:
    """Writes a valid TUM log of `frames` small images and returns its folder, for a test to damage."""

    def make(frames: int = 5, *, name: str = "log", period: float = 1 / 30, depth_delay: float = 0.0) -> Path:
        folder = tmp_path / name
        for part in ("rgb", "depth"):
            (folder / part).mkdir(parents=True)
        stamps = [i * period for i in range(frames)]
        for i in range(frames):
            cv2.imwrite(str(folder / f"rgb/{i:06d}.png"), color_image(i)[..., ::-1])
            cv2.imwrite(str(folder / f"depth/{i:06d}.png"), depth_units(i))
        lines = {
            "rgb": [f"{t:.6f} rgb/{i:06d}.png" for i, t in enumerate(stamps)],
            "depth": [f"{t + depth_delay:.6f} depth/{i:06d}.png" for i, t in enumerate(stamps)],
            "groundtruth": [f"{t:.6f} {0.01 * i} 0 0 0 0 0 1" for i, t in enumerate(stamps)],
        }
        for part, rows in lines.items():
            (folder / f"{part}.txt").write_text("\n".join(["# heading", *rows]) + "\n")
        (folder / "intrinsics.json").write_text(json.dumps(INTRINSICS))
        return folder

    return make


@pytest.fixture
def drop_line() -> Callable[[Path, int], str]:
    """Removes line `number` (from 1) of a text file and returns it."""

    def drop(path: Path, number: int) -> str:
        lines = path.read_text().splitlines(keepends=True)
        dropped = lines.pop(number - 1)
        path.write_text("".join(lines))
        return dropped

    return drop


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(20240611)


def color_image(index: int) -> NDArray[np.uint8]:
    """Return a random RGB image (48, 64, 3) that differs for each frame."""
    return np.random.default_rng(index).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth_units(index: int) -> NDArray[np.uint16]:
    """Return the depth (48, 64) of a slanted plane near 1 m in units of 1/5000 m, with a hole."""
    z = 1.0 + 0.002 * np.arange(WIDTH)[None, :] + 0.001 * np.arange(HEIGHT)[:, None] + 0.01 * index
    z[:4, :4] = 0.0
    return np.rint(z * DEPTH_SCALE).astype(np.uint16)
