"""`splatbot serve` as a process: it starts, answers and ends, and reports errors of its arguments."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from splatbot.cli import main
from splatbot.service_key import key_file, read_key
from tests.contracts.conftest import wall

COMMAND = (sys.executable, "-m", "splatbot", "serve")


@contextmanager
def serving(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], httpx.Client]]:
    """Run a service, and yield a client of it."""
    process = subprocess.Popen([*COMMAND, *arguments, "--port", "0"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = re.search(r"http://\S+", process.stdout.readline())
        assert url, f"exit code {process.wait(10)}"
        key = {"Authorization": f"Bearer {read_key(key_file())}"}
        with httpx.Client(base_url=url[0], timeout=60, headers=key) as client:
            yield process, client
    finally:
        process.kill()
        process.wait(10)


def refused(*arguments: str) -> str:
    done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.ply"
    wall().model.save(path)
    return path


@pytest.mark.parametrize("by", ["file", "run folder"])
def test_a_map_is_served_until_sigterm_which_ends_cleanly(map_file: Path, by: str) -> None:
    with serving("--map", str(map_file if by == "file" else map_file.parent)) as (process, client):
        assert [m["id"] for m in client.get("/v1/maps").json()["maps"]] == ["default"]
        answer = client.post("/v1/maps/default/distance", json={"points": [[0, 0, 1.0], [0, 0, 0.5]]}).json()
        assert answer["inside"] == [True, False]
        assert client.get("/v1/maps/default").json()["source"] == "map.ply"
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0


def test_a_service_that_gets_sigterm_while_it_starts_ends(map_file: Path) -> None:
    words = (*COMMAND, "--map", str(map_file), "--port", "0")
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        for _ in range(2):  # the address, and the file of the key
            process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) in (0, -signal.SIGTERM)
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "--map"),
        (["--map", "map.ply", "--log", "synthetic:tabletop"], "--map"),
        (["--map", "none.ply"], "none.ply"),
        (["--log", "nowhere"], "nowhere"),
    ],
)
def test_wrong_arguments_are_named_with_their_fix(
    words: list[str],
    named: str,
    map_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(map_file.parent)
    assert main(["serve", *words]) == 2
    said = capsys.readouterr().err
    assert named in said
    assert "Fix:" in said
    assert "Traceback" not in said


def test_a_port_that_is_taken_is_named(map_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert main(["serve", "--map", str(map_file), "--port", port]) == 2
    said = capsys.readouterr().err
    assert port in said
    assert "Traceback" not in said


@pytest.mark.long
def test_a_damaged_map_is_named(map_file: Path) -> None:
    map_file.write_bytes(map_file.read_bytes()[:-100])
    assert "map.ply" in refused("--map", str(map_file))
