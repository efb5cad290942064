"""`splatbot compare`: the page, its JSON, and inputs that cannot be compared."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatbot.formats import load_gaussians, save_gaussians
from splatbot.formats.ply import save_ply
from splatbot.gaussians import GaussianModel
from tests.unit.cli.conftest import RunCommand, assert_fix_named
from tests.unit.formats.models import detailed_model


@pytest.fixture
def source(work_folder: Path) -> Path:
    """A map file without a recording."""
    save_ply(detailed_model(100, degree=0), work_folder / "map.ply", bookkeeping=True)
    return work_folder / "map.ply"


def test_a_file_in_another_format_is_compared_in_virtual_views(run: RunCommand, source: Path) -> None:
    save_gaussians(load_gaussians(source), "map.spz")
    answer = run("compare", source, "map.spz", "--views", 2, "--out", "pages/two.html")
    assert answer.code == 0, answer.err
    assert "virtual 1" in Path("pages/two.html").read_text(encoding="utf-8")
    figures = json.loads(Path("pages/two.json").read_text(encoding="utf-8"))
    assert len(figures["views"]) == 2
    assert figures["means"]["psnr_db"] > 30
    assert figures["a"]["gaussians"] == 100
    assert figures["notes"] == []
    assert "PSNR of B against A" in answer.out


def test_a_run_and_a_file_are_scored_against_the_recording(run: RunCommand, run_folder: Path) -> None:
    out = run_folder.parent / "compare.html"
    assert run("convert", run_folder, run_folder / "map.sog").code == 0
    answer = run("compare", run_folder, run_folder / "map.sog", "--views", 1, "--out", out)
    assert answer.code == 0, answer.err
    figures = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert figures["means"]["psnr_a_db"] == pytest.approx(figures["means"]["psnr_b_db"], abs=2)


def test_equal_maps_have_no_psnr_and_valid_json(run: RunCommand, source: Path) -> None:
    answer = run("compare", source, source, "--views", 1)
    assert answer.code == 0, answer.err
    assert json.loads(Path("compare.json").read_text(encoding="utf-8"))["means"]["psnr_db"] is None


def test_a_lost_recording_is_noted_and_virtual_views_are_used(
    run: RunCommand, run_folder: Path, log_folder: Path, work_folder: Path
) -> None:
    log_folder.rename(log_folder.with_name("moved"))
    answer = run("compare", run_folder, run_folder, "--views", 1)
    assert answer.code == 0, answer.err
    assert "cannot be read" in " ".join(answer.out.split())
    found = run("compare", run_folder, run_folder, "--views", 1, "--log", log_folder.with_name("moved"))
    assert "against the recording" in found.out


def test_maps_that_do_not_overlap_are_named(run: RunCommand, source: Path) -> None:
    model = load_gaussians(source)
    save_ply(replace(model, means=model.means + torch.tensor([100.0, 0, 0])), Path("far.ply"))
    answer = run("compare", source, "far.ply", "--views", 2)
    assert answer.code == 0
    assert "do not overlap" in answer.out
    assert "do not overlap" in Path("compare.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (["map.ply", "map.ply", "--views", "0"], "--views"),
        (["map.ply", "map.ply", "--views", "1000"], "--views"),
        (["map.ply", "map.ply", "--out", "a.png"], "--out"),
        (["map.ply", "gone.ply"], "does not exist"),
        (["map.ply", "empty.ply"], "is empty"),
    ],
)
def test_inputs_that_cannot_be_compared_are_refused(
    run: RunCommand, source: Path, words: list[str], mistake: str
) -> None:
    save_ply(GaussianModel.empty(), source.with_name("empty.ply"))
    assert_fix_named(run("compare", *words), mistake)
    assert not Path("compare.html").exists()
