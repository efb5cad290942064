"""Real commands on a small synthetic recording that SLAM can track."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from splatbot.cli import main
from splatbot.logs import open_log
from splatbot.logs.record import record

N_FRAMES = 10
COMMAND = (sys.executable, "-m", "splatbot")


@dataclass(frozen=True)
class Answer:
    code: int
    out: str
    err: str


def splatbot(*words: object, timeout: float = 300.0) -> Answer:
    """Run `splatbot WORDS...` as a process of its own."""
    done = subprocess.run(
        [*COMMAND, *(str(word) for word in words)], capture_output=True, text=True, timeout=timeout, check=False
    )
    return Answer(done.returncode, done.stdout, done.stderr)


def splatbot_here(*words: object) -> Answer:
    """Run `splatbot WORDS...` in this process, without the seconds in which a new one loads its libraries."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(word) for word in words])
    return Answer(code, out.getvalue(), err.getvalue())


def metrics_of(folder: Path) -> dict[str, Any]:
    """Load ``metrics.json`` of a run."""
    values: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return values


@pytest.fixture(scope="session")
def sound_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded table top, 320x240; not to be written to."""
    folder = tmp_path_factory.mktemp("logs") / "tabletop"
    scene = open_log(f"synthetic:tabletop?frames={N_FRAMES}&width=320&height=240&arc=6")
    record(scene, folder, ground_truth=scene.ground_truth)
    return folder


@pytest.fixture
def log_copy(sound_log: Path, tmp_path: Path) -> Path:
    """A copy of it to damage."""
    return Path(shutil.copytree(sound_log, tmp_path / "tabletop"))


@pytest.fixture(scope="session")
def sound_run(sound_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run; not to be written to."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    answer = splatbot("map", sound_log, "--out", folder, "--set", "mapping.final_iterations=40")
    assert answer.code == 0, answer.err
    return folder
