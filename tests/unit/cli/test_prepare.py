"""`splatbot prepare`: numbers of photographs that COLMAP is not given; tests/unit/training/datasets has its results."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.unit.cli.conftest import RunCommand, assert_fix_named


@pytest.mark.parametrize("frames", [0, 2, 2001])
def test_a_number_of_frames_that_makes_no_scene_is_named_with_its_flag(
    run: RunCommand, work_folder: Path, frames: int
) -> None:
    (work_folder / "photographs").mkdir()
    answer = run("prepare", "photographs", "--out", "scene", "--frames", frames)
    assert_fix_named(answer, f"--frames: is {frames:,}. Fix: give 3 to 2,000")
    assert not Path("scene").exists()


def test_a_folder_of_too_few_photographs_is_named(run: RunCommand, work_folder: Path) -> None:
    (work_folder / "photographs").mkdir()
    (work_folder / "photographs" / "a.png").touch()
    assert_fix_named(run("prepare", "photographs", "--out", "scene"), "photographs: images: makes 1 photographs")
    assert not Path("scene").exists()
