"""Ctrl-C of `splatbot train` before the first step."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from splatbot.training.session import TrainingSession
from tests.unit.cli.conftest import RunCommand
from tests.unit.training.rendered import write_blender_scene


def test_ctrl_c_before_the_first_step_leaves_no_folder_and_is_named(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = TrainingSession.__init__

    def interrupted(self: TrainingSession, *given: object, **options: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        begin(self, *given, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(TrainingSession, "__init__", interrupted)
    (tmp_path / "scene").mkdir()
    answer = run("train", write_blender_scene(tmp_path / "scene", 4), "--out", tmp_path / "out")
    assert (answer.code, answer.err.splitlines()[-1]) == (130, "interrupted; nothing was trained yet")
    assert not (tmp_path / "out").exists()
