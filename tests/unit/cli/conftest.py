"""The command line in this process, with the oracle in SLAM's place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from splatbot.cli import main
from splatbot.config import Config
from splatbot.logs import open_log
from tests.unit.oracle import OracleSlam


@dataclass
class Answer:
    code: int
    out: str
    err: str


def assert_refused(answer: Answer, message: str) -> None:
    """Assert that a command refuses its words in plain text."""
    assert answer.code in (1, 2)
    assert message in answer.err
    assert "Traceback" not in answer.err


def assert_fix_named(answer: Answer, mistake: str) -> None:
    """Assert that a command names a user's mistake and its fix."""
    assert answer.code == 2
    assert mistake in answer.err
    assert "Fix:" in answer.err


RunCommand = Callable[..., Answer]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> RunCommand:
    """Runs `splatbot WORDS...` and returns its exit code and output."""

    def call(*words: object) -> Answer:
        capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as exit_:  # tyro leaves so after --help and wrong usage
            code = exit_.code if isinstance(exit_.code, int) else 1
        captured = capsys.readouterr()
        return Answer(code, captured.out, captured.err)

    return call


@pytest.fixture
def work_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, empty."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def log_folder(make_log: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A sound log of 16 frames; SLAM is the oracle that knows its poses."""
    folder = make_log(16)
    truth = open_log(folder).ground_truth
    assert truth is not None

    def slam(config: Config) -> OracleSlam:
        return OracleSlam(truth, config)

    monkeypatch.setattr("splatbot.run.job.Slam", slam)
    monkeypatch.setattr("splatbot.run.saving.Saver.save", lambda self, loop: None)  # an oracle has no state to save
    return folder


@pytest.fixture
def run_folder(run: RunCommand, log_folder: Path, tmp_path: Path) -> Path:
    """The folder of a finished run of ``log_folder``."""
    assert run("map", log_folder, "--out", tmp_path / "run", "--no-report", "--quiet").code == 0
    return tmp_path / "run"
