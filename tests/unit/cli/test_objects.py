"""`splatbot objects`: hand and reach of each object, and the margin of the arm."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.tabletop import Block
from splatbot.workspace import Workspace
from tests.terminal import at_a_terminal
from tests.unit.cli.conftest import RunCommand, assert_fix_named
from tests.unit.grasping.objects import BOX, colored, model


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.ply"
    model().save(path)
    Workspace(T_world_base=np.eye(4)).save(tmp_path / "scene.yaml")
    return path


def test_each_word_of_the_table_has_its_meaning_and_80_columns_hold_the_table(map_file: Path) -> None:
    shown = at_a_terminal("objects", str(map_file), "--margin", "0.3", columns=80)
    assert shown.code == 0, shown.text
    assert shown.longest_line() <= 80
    assert "┃ reach" in shown.text  # a table, and not a record of each object
    text = " ".join(shown.text.split())
    assert "blocked: each posture found for the tool at its centre meets the map or the arm" in text
    assert "too wide: its faces are farther apart than the hand opens" in text
    assert "margin of the arm before its hand: 300.0 mm, as given" in text
    assert map_file.with_name("objects.png").is_file()


def test_the_json_has_the_reach_of_each_object_and_the_margin(run: RunCommand, map_file: Path) -> None:
    found = json.loads(run("objects", map_file, "--json").out)
    assert {item["reach"] for item in found["objects"]} == {"yes"}
    assert found["arm_margin_m"] == 0.0  # of a map file, which has no recording to audit


@pytest.fixture
def walled_map(tmp_path: Path) -> Path:
    """A map whose workspace box cuts a wall, behind a box."""
    path, wall = tmp_path / "map.ply", Block((0.8, 0.0, 0.15), (0.005, 0.6, 0.3))
    colored({"box": BOX, "wall": wall}, 40_000, {"box": (0.8, 0.1, 0.1)}).save(path)
    low_high = np.array([[0.2, -0.1, -0.1], [1.2, 0.15, 0.8]])
    Workspace(T_world_base=np.eye(4), box=low_high).save(tmp_path / "scene.yaml")
    return path


def test_a_wall_is_listed_as_structure_apart_from_the_objects(walled_map: Path) -> None:
    shown = at_a_terminal("objects", str(walled_map), columns=80)
    assert shown.code == 0, shown.text
    assert shown.longest_line() <= 80
    objects, _, structure = shown.text.partition("\nstructure ")
    assert "red box" in objects
    assert "continues in other surface" in structure
    assert "┃ why" in structure  # a table, and not a record of each piece
    assert "red box" not in structure


def test_the_widest_box_of_a_walled_map_is_not_the_wall(run: RunCommand, walled_map: Path, tmp_path: Path) -> None:
    listed = json.loads(run("objects", walled_map, "--json").out)["objects"]
    (wall,) = (item for item in listed if item["kind"] == "structure")
    (box,) = (item for item in listed if item["kind"] == "object")
    assert (wall["target"], box["target"]) == (None, f"object {box['number']}")
    words = ("grasp", "--map", walled_map, "--target", "widest box", "--hand-only", "--wanted", 1)
    answer = run(*words, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    grasped = json.loads((tmp_path / "out" / "grasp.json").read_text())
    assert np.abs(BOX.distance(np.array(grasped["grasps"][0]["contacts"]))).max() < 3e-3


@pytest.mark.parametrize(
    ("margin", "mistake"),
    [("wide", "--margin: is 'wide'"), ("-1", "--margin: is '-1'"), ("auto", "needs a run folder")],
)
def test_a_wrong_margin_is_refused(run: RunCommand, map_file: Path, margin: str, mistake: str) -> None:
    assert_fix_named(run("objects", map_file, "--margin", margin), mistake)
    assert not map_file.with_name("objects.png").exists()
