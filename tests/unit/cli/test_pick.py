"""`splatbot pick`: from a scan of the twin to an object in the hand."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.unit.cli.conftest import RunCommand

pytest.importorskip("mujoco")

SCENE = """
name: two
objects:
  - {name: table, shapes: [{kind: plane}]}
  - {name: can, shapes: [{kind: cylinder, radius: 0.03, height: 0.12}], at: [0.5, -0.1, 0.06], movable: true, mass: 0.3}
  - {name: slab, shapes: [{kind: box, size: [0.16, 0.14, 0.10]}], at: [0.5, 0.2, 0.05], movable: true, mass: 0.5}
camera: {at: [1.3, -0.7, 0.8], look_at: [0.4, 0.0, 0.1], sensor: ["depth_noise"]}
task: {kind: grasp}
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "two.yaml"
    path.write_text(SCENE)
    return path


def test_a_can_is_taken_and_the_twin_says_how_far_it_rose(run: RunCommand, scene: Path, tmp_path: Path) -> None:
    answer = run("pick", scene, "--target", "can", "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert "can (scene): picked" in answer.out
    written = json.loads((tmp_path / "out" / "pick.json").read_text())
    assert written["outcome"] == "picked"
    assert written["rose_m"]["can"] == pytest.approx(0.15, abs=0.01)
    assert abs(written["rose_m"]["slab"]) < 0.002


@pytest.mark.long
def test_a_can_that_was_pushed_aside_after_the_scan_is_looked_for_and_taken(
    run: RunCommand, scene: Path, tmp_path: Path
) -> None:
    answer = run("pick", scene, "--target", "can", "--moved", 0.03, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    written = json.loads((tmp_path / "out" / "pick.json").read_text())
    assert written["shift_m"] == pytest.approx(0.03, abs=0.004)
    assert written["attempts"] == 1
    assert written["rose_m"]["can"] == pytest.approx(0.15, abs=0.01)
    assert "look" in answer.out
    assert run("pick", scene, "--target", "can", "--moved", 0.03, "--no-look", "--out", tmp_path / "blind").code == 1
    assert run("pick", scene, "--target", "can", "--moved", 0.3).code == 2


def test_an_object_that_is_too_wide_has_no_grasp_and_nothing_moves(
    run: RunCommand, scene: Path, tmp_path: Path
) -> None:
    answer = run("pick", scene, "--target", "slab", "--out", tmp_path / "out")
    assert answer.code == 1
    assert "no grasp" in answer.err
    written = json.loads((tmp_path / "out" / "pick.json").read_text())
    assert (written["outcome"], written["stage"]) == ("no grasp", "grasp")
    assert all(abs(by) < 0.002 for by in written["rose_m"].values())


def test_wrong_words_are_named(run: RunCommand, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPLATBOT_VLM_URL", raising=False)
    assert run("pick", scene, "--target", "zeppelin", "--views", 2).code == 2
    answer = run("pick", scene, "--target", "can", "--vlm")
    assert answer.code == 2
    assert "SPLATBOT_VLM_URL" in answer.err
    assert run("pick", "no-such-scene", "--target", "can").code == 2
