"""`splatbot train` with values that it estimates for the photographs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from splatbot.cli import main
from tests.unit.training.wide import write_wide_scene


def train(scene: Path, out: Path, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Train for three steps and return the printed summary."""
    assert main(["train", str(scene), "--iterations", "3", "--max-gaussians", "200", "--out", str(out), *words]) == 0
    return capsys.readouterr().out


def test_the_summary_has_both_scores_and_the_first_cameras_before_and_after(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_wide_scene(tmp_path / "scene", points=200, rows=3)
    file = scene / "transforms.json"
    values = json.loads(file.read_text())
    for index, frame in enumerate(values["frames"]):
        frame["fl_x"] = frame["fl_y"] = 48.0 + index
    file.write_text(json.dumps(values))
    out = tmp_path / "out"
    printed = train(scene, out, capsys, "--exposure", "--refine-intrinsics")
    assert re.search(r"^  PSNR +\d+\.\d dB$", printed, re.M)
    assert re.search(r"^  colour-corrected PSNR +\d+\.\d dB$", printed, re.M)
    assert re.search(
        r"^  camera 1 +fx 49\.00 → \d+\.\d\d, fy 49\.00 → \S+, cx 31\.50 → \S+, cy 23\.50 → \S+ px$", printed, re.M
    )
    assert re.search(rf"^  more cameras +3, in {out}/cameras\.json$", printed, re.M)  # 7 of 9 views train
    assert len(json.loads((out / "exposures.json").read_text())) == 7


def test_without_the_options_nothing_is_estimated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    printed = train(write_wide_scene(tmp_path / "scene", points=200, rows=3), out, capsys)
    assert "colour-corrected PSNR" in printed
    assert "camera" not in printed
    assert not {"cameras.json", "exposures.json"} & {path.name for path in out.iterdir()}


def test_eval_scores_held_out_views_with_the_refined_intrinsics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    train(write_wide_scene(tmp_path / "scene", points=200, rows=3), out, capsys, "--refine-intrinsics")
    values = json.loads((out / "cameras.json").read_text())
    values["cameras"][0]["refined"]["fx"] *= 1.5
    assert main(["eval", str(out), "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    saved = json.loads((out / "scores.json").read_text())
    assert saved | scores == saved
    (out / "cameras.json").write_text(json.dumps(values))
    assert main(["eval", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["psnr_db"] != scores["psnr_db"]


def test_a_resume_with_other_images_is_refused_and_the_training_keeps_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    train(write_wide_scene(tmp_path / "scene", points=200, rows=3), out, capsys)
    before = (out / "training.json").read_bytes()
    other = write_wide_scene(tmp_path / "other", points=200, rows=2)
    assert main(["train", str(other), "--resume", str(out)]) == 2
    assert "give their place" in capsys.readouterr().err
    assert (out / "training.json").read_bytes() == before
