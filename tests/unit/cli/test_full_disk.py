"""Disks that are full, read-only or gone: a sentence, exit code 1, and earlier files stay intact."""

from __future__ import annotations

import hashlib
import os
import resource
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

LOG = "synthetic:tabletop?frames=8&width=160&height=120"


def splatbot(*words: object, most_bytes: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command, in which no file can become larger than ``most_bytes``, as if the disk were full."""

    def limit() -> None:
        if most_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    command = [sys.executable, "-m", "splatbot", *map(str, words)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, preexec_fn=limit, env=environment, check=False
    )


def contents(folder: Path) -> dict[str, str]:
    """Return checksums of the files in a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def assert_sentence(answer: subprocess.CompletedProcess[str]) -> None:
    assert answer.returncode == 1, answer.stderr
    assert "Traceback" not in answer.stderr
    last = answer.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert " Fix: " in last


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with its saved state."""
    folder = tmp_path_factory.mktemp("disk") / "run"
    answer = splatbot("map", LOG, "--out", folder, "--max-frames", 5, "--quiet")
    assert answer.returncode == 0, answer.stderr
    return folder


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A mounted disk of 300 kB."""
    place = tmp_path / "small"
    place.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", place], capture_output=True, check=False)
    if made.returncode:
        pytest.skip("a small disk cannot be mounted here")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=False, capture_output=True)


@pytest.mark.long
@pytest.mark.parametrize("command", ["overwrite", "resume"])
def test_map_to_a_full_disk_keeps_the_run_and_its_state(mapped: Path, command: str) -> None:
    before = contents(mapped)
    words = ["--out", mapped, "--overwrite"] if command == "overwrite" else ["--resume", mapped]
    answer = splatbot("map", LOG, *words, "--quiet", most_bytes=20_000)
    assert_sentence(answer)
    after = contents(mapped)
    kept = {name: total for name, total in after.items() if name in before}
    assert kept == before
    assert not [name for name in after if name.endswith((".tmp", ".draft"))]
    assert splatbot("eval", mapped).returncode == 0


@pytest.mark.long
@pytest.mark.parametrize("command", ["simulate", "record", "render", "plan", "map"])
def test_a_command_that_fills_the_disk_says_so(small_disk: Path, mapped: Path, command: str) -> None:
    out = small_disk / "out"
    words: dict[str, Sequence[object]] = {
        "simulate": ["tabletop", "--frames", 30, "--size", "320x240", "--out", out],
        "record": [LOG.replace("frames=8", "frames=30"), "--out", out.with_suffix(".mcap")],
        "render": [mapped, "--size", "1600x1200", "--out", out.with_suffix(".png")],
        "plan": f"--map {mapped} --base 0 0.4 1 1 0 0 0 --start home --goal home --margin 0 --out {out}".split(),
        "map": [LOG, "--out", out],
    }
    (small_disk / "fill").write_bytes(b"x" * 200_000)
    answer = splatbot(command, *words[command])
    assert_sentence(answer)
    assert "no space left" in answer.stderr
    assert (small_disk / "fill").stat().st_size == 200_000


@pytest.mark.long
def test_a_recording_that_filled_the_disk_is_a_shorter_one(small_disk: Path) -> None:
    answer = splatbot("simulate", "tabletop", "--frames", 30, "--size", "160x120", "--out", small_disk / "log")
    assert_sentence(answer)
    info = splatbot("info", small_disk / "log")
    assert info.returncode == 0, info.stderr


@pytest.mark.parametrize("command", ["map", "simulate", "record", "render", "plan", "serve"])
def test_a_folder_that_is_read_only_is_refused_before_the_work(
    tmp_path: Path, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from splatbot.cli import main

    (tmp_path / "map.ply").touch()
    out = tmp_path / "out"
    words: dict[str, list[object]] = {
        "map": [LOG, "--out", out],
        "simulate": ["tabletop", "--out", out],
        "record": [LOG, "--out", out],
        "render": [tmp_path, "--out", out],
        "plan": ["--map", tmp_path, "--start", "home", "--goal", "home", "--out", out],
        "serve": ["--data", out],
    }
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    assert main([command, *map(str, words[command])]) == 1
    assert "error: " in capsys.readouterr().err
    assert not out.exists()
