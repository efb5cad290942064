"""Items from inputs and options: their names and command lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.batch.sweep import make_items
from splatbot.errors import InputError


def test_each_input_is_an_item_with_an_absolute_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "desk").mkdir()
    (tmp_path / "lab.mcap").touch()
    monkeypatch.chdir(tmp_path)
    items = make_items("map", ["desk", "lab.mcap?pair_within=0.05", "synthetic:room?frames=4"], [["no-report"]], {})
    assert [item.name for item in items] == ["desk", "lab", "room-frames-4"]
    assert [item.words for item in items] == [
        ("map", str(tmp_path / "desk"), "--no-report"),
        ("map", f"{tmp_path / 'lab.mcap'}?pair_within=0.05", "--no-report"),
        ("map", "synthetic:room?frames=4", "--no-report"),
    ]


def test_several_values_of_options_make_an_item_of_each_combination() -> None:
    items = make_items("trials", [], [["scenes", "bin", "shelf"], ["first", "0", "50"], ["stacks", "mesh cloud"]], {})
    assert {item.name: item.words[1:] for item in items} == {
        "scenes-bin-first-0": ("--scenes", "bin", "--first", "0", "--stacks", "mesh", "cloud"),
        "scenes-bin-first-50": ("--scenes", "bin", "--first", "50", "--stacks", "mesh", "cloud"),
        "scenes-shelf-first-0": ("--scenes", "shelf", "--first", "0", "--stacks", "mesh", "cloud"),
        "scenes-shelf-first-50": ("--scenes", "shelf", "--first", "50", "--stacks", "mesh", "cloud"),
    }


def test_options_with_one_value_do_not_change_names() -> None:
    assert make_items("trials", [], [["trials", "5"]], {})[0].name == "trials"


def test_an_input_can_be_named_and_a_path_with_an_equals_sign_cannot_be_mistaken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rate=1").mkdir()
    monkeypatch.chdir(tmp_path)
    items = make_items("map", ["one=synthetic:room?frames=4", "rate=1"], [], {})
    assert [(item.name, item.words[1]) for item in items] == [
        ("one", "synthetic:room?frames=4"),
        ("rate-1", str(tmp_path / "rate=1")),
    ]


@pytest.mark.parametrize(
    ("inputs", "problem"),
    [
        (["a/log", "b/log", "log=a/log", "log=b/log"], "2 items have the name 'log'"),
        (["synthetic:" + 200 * "x"], "cannot be one of a folder"),
        (["batch.json=a/log"], "cannot be one of a folder"),
    ],
)
def test_names_that_cannot_be_folders_of_one_batch_are_refused(inputs: list[str], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        make_items("map", inputs, [], {})


def test_a_sweep_is_bounded_before_its_items_exist() -> None:
    values = [str(value) for value in range(100)]
    with pytest.raises(InputError, match="1,000,000 items"):
        make_items("trials", [], [["first", *values], ["frames", *values], ["width", *values]], {})
