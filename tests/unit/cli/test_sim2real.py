"""`splatbot sim2real`: options, names in the output, and files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.sim.compare.views import TwinViews
from splatbot.workspace import Workspace
from tests.unit.cli.conftest import RunCommand

pytest.importorskip("mujoco")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "--held-out"),
        (["some/log"], "LOG, --map"),
        (["--held-out", "--task", "juggle"], "tasks: reach, push"),
        (["--held-out", "--trials", "0"], "positive"),
    ],
)
def test_wrong_words_are_named(run: RunCommand, words: list[str], message: str) -> None:
    answer = run("sim2real", *words)
    assert answer.code == 2
    assert message in answer.err


def test_a_log_without_an_arm_is_compared_at_tracked_poses(
    run: RunCommand, log_folder: Path, run_folder: Path, tmp_path: Path
) -> None:
    """Build a run of a scene without objects on a surface; its log has neither tool poses nor joints."""
    Workspace(np.eye(4)).save(log_folder / "scene.yaml")
    answer = run("sim2real", log_folder, "--map", run_folder, "--frames", "3", "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    found = json.loads((tmp_path / "out" / "sim2real.json").read_text())
    assert found["kind"] == "sim-to-real"
    assert found["poses"].startswith("tracked")
    assert found["replay"] is None
    assert found["summary"]["all"]["frames"] == 3
    page = (tmp_path / "out" / "sim2real.html").read_text()
    for text in (answer.out, page, json.dumps(found)):
        assert "sim-to-real" in text
        assert "sim-to-sim" not in text


def test_a_stop_between_frames_keeps_what_was_compared(
    run: RunCommand, log_folder: Path, run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Workspace(np.eye(4)).save(log_folder / "scene.yaml")
    compare = TwinViews.compare
    seen: list[int] = []

    def stopped(self, *args, **kwargs):  # type: ignore[no-untyped-def]
        if len(seen) == 2:
            raise KeyboardInterrupt
        seen.append(1)
        return compare(self, *args, **kwargs)

    monkeypatch.setattr(TwinViews, "compare", stopped)
    answer = run("sim2real", log_folder, "--map", run_folder, "--out", tmp_path / "out")
    assert answer.code == 130
    found = json.loads((tmp_path / "out" / "sim2real.json").read_text())
    assert found["interrupted"]
    assert found["summary"]["all"]["frames"] == 2
    assert "Interrupted" in (tmp_path / "out" / "sim2real.html").read_text()


@pytest.mark.long
def test_a_held_out_twin_is_never_called_real(run: RunCommand, tmp_path: Path) -> None:
    answer = run("sim2real", "--held-out", "--quick", "--out", tmp_path)
    assert answer.code == 0, answer.err
    found = json.loads((tmp_path / "sim2sim.json").read_text())
    assert [task["task"] for task in found["tasks"]] == ["reach", "push"]
    assert all(len(task["agreement"]["policies"]) >= 5 for task in found["tasks"])
    page = (tmp_path / "sim2sim.html").read_text()
    for text in (answer.out, page, json.dumps(found)):
        assert "sim-to-sim" in text
        assert "sim-to-real" not in text
    assert not (tmp_path / "sim2real.json").exists()
