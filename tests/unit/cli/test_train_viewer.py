"""`splatbot train --viewer`: the port, the address and its key, refusals before the training, Ctrl-C."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest
import websockets.sync.client

from splatbot.cli import main
from splatbot.service_key import key_file, read_key
from splatbot.services.live_training.server import LivePage
from tests.unit.services.live_training.browsers import receive, want
from tests.unit.training.rendered import write_blender_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Blender scene of 4 photographs."""
    return write_blender_scene(tmp_path_factory.mktemp("blender"), 4)


def test_the_map_is_the_same_as_without_the_viewer_and_the_address_is_printed(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, words in (("plain", ()), ("seen", ("--viewer", "0"))):
        assert main(["train", str(scene), "--iterations", "8", "--out", str(tmp_path / name), *words]) == 0
    assert (tmp_path / "plain" / "map.ply").read_bytes() == (tmp_path / "seen" / "map.ply").read_bytes()
    out = capsys.readouterr().out
    assert re.findall(r"http://127\.0\.0\.1:\d+/\?key=KEY \(KEY is in (.*)\) shows the training", out) == [
        str(key_file())
    ]
    assert str(read_key(key_file())) not in out  # pytest's stdout is a file
    assert re.search(r"the viewer took \d\.\d % of the time", out)


def test_a_taken_port_is_refused_before_the_folder_is_made(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with LivePage(0) as page:
        words = ["train", str(scene), "--out", str(tmp_path / "out"), "--viewer", str(page.port)]
        assert main(words) == 2
    assert f"--viewer: cannot listen on 127.0.0.1 port {page.port}" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--viewer", "65536"), "--viewer: is 65536"),
        (("--viewer", "1", "2"), "--viewer: is 1 2"),
        (("--viewer", "--blocks", "2"), "--viewer: shows one training"),
    ],
)
def test_a_wrong_port_and_blocks_are_refused(
    words: tuple[str, ...], message: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", str(scene), "--out", str(tmp_path / "out"), *words]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert "Fix:" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.long
@pytest.mark.parametrize("processes", ["1", "2"])
def test_ctrl_c_ends_the_page_with_the_last_state_and_process_0_alone_serves_it(
    processes: str, scene: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = [str(scene), "--iterations", "1000000", "--out", str(out), "--viewer", "0", "--processes", processes]
    process = subprocess.Popen(
        [sys.executable, "-m", "splatbot", "train", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        port = re.search(r"127\.0\.0\.1:(\d+)", process.stdout.readline())[1]  # type: ignore[index]
        with urlopen(f"http://127.0.0.1:{port}/?key={read_key(key_file())}", timeout=30) as answer:
            cookie = answer.headers["Set-Cookie"].partition(";")[0]
        with websockets.sync.client.connect(
            f"ws://127.0.0.1:{port}/live", additional_headers={"Cookie": cookie}, proxy=None
        ) as browser:
            receive(browser, "scene")
            want(browser, 0, 96)
            assert receive(browser, "picture")["iteration"] > 0
            process.send_signal(signal.SIGINT)
            while not (status := receive(browser, "status"))["ended"]:
                pass
        printed, err = process.communicate(timeout=120)
        assert process.returncode == 130, err
        assert status["iteration"] == json.loads((out / "scores.json").read_text())["iterations"]
        assert printed.count("http://") == 0  # the address was printed once
        assert "the viewer took" in printed
    finally:
        process.kill()
        process.wait()
