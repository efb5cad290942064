"""`splatbot compact`: files, the sweep, and refused options."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField
from splatbot.formats import load_gaussians
from splatbot.formats.ply import save_ply
from tests.terminal import at_a_terminal
from tests.unit.cli.conftest import RunCommand, assert_fix_named, assert_refused
from tests.unit.formats.models import detailed_model


@pytest.fixture
def source(work_folder: Path) -> Path:
    """A map file without a recording, with harmonics of degree 2."""
    save_ply(detailed_model(200, degree=2), work_folder / "map.ply", bookkeeping=True)
    return work_folder / "map.ply"


@pytest.mark.parametrize("name", ["half.ply", "half.sbz"])
def test_a_file_of_half_the_gaussians_hits_all_that_the_map_hits(run: RunCommand, source: Path, name: str) -> None:
    answer = run("compact", source, "--keep", "0.5", "--out", name)
    assert answer.code == 0, answer.err
    assert "48 virtual views" in answer.out
    assert "note:" not in answer.out
    before, after = load_gaussians(source), load_gaussians(name)
    assert 0 < len(after) <= 100
    points = before.means.numpy().repeat(50, axis=0)
    points = points + np.random.default_rng(0).normal(0, 0.1, points.shape)
    hit, hit_after = (GaussianCollisionField(model).in_collision(points) for model in (before, after))
    assert hit.any()
    assert not (hit & ~hit_after).any()


def test_harmonics_are_cut_and_rounding_formats_are_named(run: RunCommand, source: Path) -> None:
    answer = run("compact", source, "--max-gaussians", 50, "--sh-degree", 1, "--out", "small.spz")
    assert answer.code == 0, answer.err
    after = load_gaussians("small.spz")
    assert len(after) <= 50
    assert after.sh_degree == 1
    assert "SPZ rounds ellipsoids" in answer.out


def test_a_run_is_weighed_by_its_recording_and_scored_on_held_out_views(run: RunCommand, run_folder: Path) -> None:
    answer = run("compact", run_folder, "--keep", "0.3", "--out", run_folder / "small.ply")
    assert answer.code == 0, answer.err
    assert "views of" in answer.out
    assert "dB" in answer.out
    assert "0 of " in answer.out


def test_a_file_is_weighed_by_the_cameras_of_a_run(run: RunCommand, run_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "map.ply").write_bytes((run_folder / "map.ply").read_bytes())
    answer = run("compact", tmp_path / "map.ply", "--cameras", run_folder, "--keep", "1", "--out", tmp_path / "a.ply")
    assert answer.code == 0, answer.err
    assert "virtual" not in answer.out


def test_a_sweep_has_a_row_for_each_share_and_writes_nothing(run: RunCommand, source: Path) -> None:
    answer = run("compact", source, "--sweep")
    assert answer.code == 0, answer.err
    assert re.findall(r"(\d+) %", answer.out)[::2] == ["100", "75", "50", "35", "25", "10"]
    assert list(source.parent.iterdir()) == [source]


def test_an_existing_file_is_replaced_only_with_overwrite(run: RunCommand, source: Path) -> None:
    words = ("compact", source, "--max-gaussians", 1, "--out", "one.ply")
    first = run(*words)
    assert first.code == 0, first.err
    assert " 0.5 %" in first.out  # of 200 Gaussians
    assert_fix_named(run(*words), "--overwrite")
    assert run(*words, "--overwrite").code == 0


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc, which takes no files, not even of root")
def test_a_folder_that_takes_no_files_is_refused_before_the_map_is_read(run: RunCommand, source: Path) -> None:
    source.write_bytes(b"no map")
    assert_refused(run("compact", source, "--keep", "0.5", "--out", "/proc/a.ply"), "/proc/a.ply")
    assert_refused(run("compare", source, source, "--out", "/proc/a.html"), "/proc/a.html")


def test_a_narrow_terminal_gets_whole_lines_and_progress(source: Path) -> None:
    shown = at_a_terminal("compact", str(source), "--sweep", columns=40)
    assert shown.code == 0, shown.text
    assert shown.live
    assert "20 Gaussians" in shown.text  # the last step of the sweep, which is always drawn
    assert shown.longest_line() <= 40


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (["--keep", "0.5"], "--out"),
        (["--out", "a.ply"], "--keep, --max-gaussians"),
        (["--out", "a.ply", "--keep", "0.5", "--max-gaussians", "5"], "--keep, --max-gaussians"),
        (["--out", "a.ply", "--keep", "0"], "--keep"),
        (["--out", "a.ply", "--keep", "1.5"], "--keep"),
        (["--out", "a.ply", "--keep", "nan"], "--keep"),
        (["--out", "a.ply", "--max-gaussians", "0"], "--max-gaussians"),
        (["--out", "a.ply", "--keep", "0.5", "--sh-degree", "7"], "--sh-degree"),
        (["--out", "map.ply", "--keep", "0.5"], "is the input"),
        (["--out", "a.txt", "--keep", "0.5"], "no known format"),
        (["--sweep", "--keep", "0.5"], "excludes --sweep"),
        (["--sweep", "--cameras", "."], "is no run"),
    ],
)
def test_options_that_do_not_fit_are_refused(run: RunCommand, source: Path, words: list[str], mistake: str) -> None:
    before = source.read_bytes()
    assert_fix_named(run("compact", source, *words), mistake)
    assert source.read_bytes() == before
    assert list(source.parent.iterdir()) == [source]
