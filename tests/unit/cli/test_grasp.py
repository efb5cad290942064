"""`splatbot grasp`."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.robots.panda import panda
from splatbot.workspace import NamedPlace, Workspace
from tests.unit.cli.conftest import RunCommand, assert_refused
from tests.unit.grasping.objects import BOX, CAN, model

BASE = ("--base", 0, 0, 0, 1, 0, 0, 0)


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.ply"
    model().save(path)
    return path


def test_ranked_grasps_are_printed_written_and_drawn(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    answer = run("grasp", "--map", map_file, *BASE, "--target", "red box", "--wanted", 3, "--out", out)
    assert answer.code == 0, answer.err
    for word in ("conf.", "width", "clear", "red box", "by rules", "errors of the map are not covered"):
        assert word in answer.out
    taken = re.search(r"(\d+)×(\d+)×(\d+) mm, at \((.*?)\)", " ".join(answer.out.split()))  # which box it took
    assert taken is not None
    np.testing.assert_allclose([float(x) for x in taken.groups()[:3]], 1e3 * np.array(BOX.size), atol=8.0)
    np.testing.assert_allclose([float(x) for x in taken[4].split(",")], BOX.center, atol=0.015)
    assert "closure" not in answer.out
    found = json.loads((out / "grasp.json").read_text())
    assert {"closure", "limits"} < set(found["grasps"][0]["terms"])
    assert found["target"]["backend"] == "rules"
    assert len(found["grasps"]) == 3
    best = found["grasps"][0]
    assert best["width_m"] == pytest.approx(BOX.size[1], abs=2e-3)
    assert np.abs(BOX.distance(np.array(best["contacts"]))).max() < 3e-3
    np.testing.assert_allclose(panda().tcp(np.array(best["q"]))[:3, 3], best["T_world_tcp"]["position"], atol=1e-4)
    picture = cv2.imread(str(out / "grasp.png"))
    assert picture is not None
    assert picture.shape == (480, 1280, 3)
    assert picture.std() > 5


def test_a_second_search_replaces_the_first_in_the_default_folder_and_says_so(
    run: RunCommand, map_file: Path, work_folder: Path
) -> None:
    words = ("grasp", "--map", map_file, *BASE, "--hand-only", "--wanted", 1)
    first = run(*words, "--target", "red box")
    assert first.code == 0, first.err
    assert "in place of earlier results" not in first.out
    failed = run(*words, "--target", "largest box")  # wider than the hand
    assert failed.code == 1
    assert "written to runs/grasp, in place of earlier results" in failed.out
    assert json.loads((work_folder / "runs" / "grasp" / "grasp.json").read_text())["grasps"] == []
    named = run(*words, "--target", "red box", "--out", "runs/grasp", "--overwrite")
    assert named.code == 0, named.err
    assert len(json.loads((work_folder / "runs" / "grasp" / "grasp.json").read_text())["grasps"]) == 1


def test_a_run_whose_log_is_gone_still_answers_and_notes_the_skipped_checks(
    run: RunCommand, map_file: Path, tmp_path: Path
) -> None:
    (tmp_path / "frames.jsonl").write_text("")
    (tmp_path / "trajectory.tum").write_text("")
    (tmp_path / "metrics.json").write_text(json.dumps({"log": {"uri": str(tmp_path / "moved")}}))
    out = tmp_path / "out"
    answer = run("grasp", "--map", tmp_path, *BASE, "--target", "red box", "--wanted", 1, "--out", out)
    assert answer.code == 0, answer.err
    (note,) = [note for note in json.loads((out / "grasp.json").read_text())["notes"] if "Visibility" in note]
    assert "moved" in note


def test_names_and_base_come_from_the_scene_file_of_the_map(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    names = (NamedPlace("soup", np.array([0.50, -0.15, 0.12])),)
    Workspace(T_world_base=np.eye(4), objects=names).save(tmp_path / "scene.yaml")
    answer = run("grasp", "--map", map_file, "--target", "soup", "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    found = json.loads((tmp_path / "out" / "grasp.json").read_text())
    assert (found["target"]["label"], found["target"]["backend"]) == ("soup", "scene")
    assert np.abs(CAN.distance(np.array(found["grasps"][0]["contacts"]))).max() < 3e-3


def test_a_point_and_the_hand_alone(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    words = ("--point", 0.50, -0.15, 0.12, "--hand-only", "--approach", "top", "--out", tmp_path / "out")
    answer = run("grasp", "--map", map_file, *BASE, *words)
    assert answer.code == 0, answer.err
    best = json.loads((tmp_path / "out" / "grasp.json").read_text())["grasps"][0]
    assert best["q"] is None
    assert best["approach"] == "top"
    assert "near" in best["terms"]


def test_unknown_space_needs_the_frames_of_a_run(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    words = ("--target", "red box", "--unknown", "cautious", "--out", tmp_path / "out")
    answer = run("grasp", "--map", map_file, *BASE, *words)
    assert answer.code == 2
    assert "--unknown: needs a run folder" in answer.err


def test_what_cannot_be_grasped_is_said_counted_and_drawn(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    answer = run("grasp", "--map", map_file, *BASE, "--target", "largest box", "--out", tmp_path / "out")
    assert answer.code == 1
    assert "120 mm apart, and the hand opens 80 mm" in answer.err
    found = json.loads((tmp_path / "out" / "grasp.json").read_text())
    assert found["grasps"] == []
    assert sum(found["rejected"].values()) > 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "give one of them"),
        (("--target", "box", "--point", 0, 0, 0), "are 2"),
        (("--target", "box"), "about equally"),
        (("--target", "screwdriver"), "nor in the vocabulary"),
        (("--pixel", 10, 10), "has no images"),
        (("--point", 0.3, -0.05, 0.0), "there is no object"),
        (("--target", "red box", "--friction", 9), "friction"),
        (("--target", "red box", "--robot", "nobody"), "robot"),
        (("--target", "red box", "--margin", "wide"), "--margin"),
    ],
)
def test_wrong_questions_are_answered_in_one_line(
    words: tuple[object, ...], message: str, run: RunCommand, map_file: Path
) -> None:
    assert_refused(run("grasp", "--map", map_file, *BASE, *words), message)


def test_a_model_needs_a_target_name_and_a_model_name(
    run: RunCommand, map_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SPLATBOT_VLM_URL", raising=False)
    answer = run("grasp", "--map", map_file, *BASE, "--target", "red box", "--vlm")
    assert answer.code == 2
    assert "SPLATBOT_VLM_URL" in answer.err
    answer = run("grasp", "--map", map_file, *BASE, "--point", 0, 0, 0, "--vlm")
    assert answer.code == 2
    assert "--target" in answer.err


def test_several_masks_need_as_many_images(run: RunCommand, map_file: Path, tmp_path: Path) -> None:
    masks = [tmp_path / f"{name}.png" for name in ("a", "b")]
    for path in masks:
        assert cv2.imwrite(str(path), np.full((4, 4), 255, np.uint8))
    answer = run("grasp", "--map", map_file, *BASE, "--mask", *masks, "--index", 3)
    assert_refused(answer, "--index: are 1 for 2. Fix: give one for each mask")
    answer = run("grasp", "--map", map_file, *BASE, "--mask", masks[0], tmp_path / "gone.png", "--index", 3, 4)
    assert_refused(answer, "gone.png")
