"""`splatbot convert`: every format, the report of losses, and refused outputs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from splatbot.formats import load_gaussians
from splatbot.formats.ply import load_ply, save_ply
from tests.unit.cli.conftest import RunCommand, assert_fix_named
from tests.unit.formats.models import detailed_model


@pytest.fixture
def source(work_folder: Path) -> Path:
    """A map of splatbot, with bookkeeping and harmonics of degree 2."""
    save_ply(detailed_model(60, degree=2), work_folder / "map.ply", bookkeeping=True)
    return work_folder / "map.ply"


@pytest.mark.parametrize(
    ("name", "degree", "losses"),
    [
        ("out.ply", 2, "lost nothing"),
        ("out.glb", 2, "lost: bookkeeping"),
        ("out.splat", 0, "lost: SH degree 2 to 0, bookkeeping; rounded: rotations, colours, opacities"),
        ("out.spz", 2, "lost: bookkeeping; rounded: positions, scales, rotations, colours, opacities, harmonics"),
        ("out.ksplat", 2, "lost: bookkeeping; rounded: positions, scales, rotations, colours, opacities, harmonics"),
        ("out.compressed.ply", 2, "lost: bookkeeping; rounded: positions"),
        (
            "out.sbz",
            0,
            "lost: SH degree 2 to 0; rounded: positions, scales, rotations, colours, opacities, uncertainty",
        ),
        ("out.sog", 2, "lost: bookkeeping; rounded: positions"),
        ("new/out_sog", 2, "lost: bookkeeping; rounded: positions"),
    ],
)
def test_a_map_is_written_in_every_format_with_a_report(
    run: RunCommand, source: Path, name: str, degree: int, losses: str
) -> None:
    answer = run("convert", source, name)
    assert answer.code == 0
    (line,) = answer.out.splitlines()
    assert line.startswith(f"{name}: 60 Gaussians, SH degree {degree}, ")
    assert " kB to " in line
    assert losses in line
    assert load_gaussians(name).sh_degree == degree
    assert run("convert", name, "back.ply").code == 0
    assert len(load_ply("back.ply")) == 60


def test_bookkeeping_stays_in_ply_files_that_had_it(run: RunCommand, source: Path) -> None:
    assert run("convert", source, "copy.ply").code == 0
    assert torch.equal(load_ply("copy.ply").anchors, load_ply(source).anchors)
    assert run("convert", source, "map.glb").code == 0
    assert run("convert", "map.glb", "foreign.ply").code == 0
    assert b"observations" not in Path("foreign.ply").read_bytes()[:2000]


def test_degrees_are_dropped_on_request(run: RunCommand, source: Path) -> None:
    answer = run("convert", source, "out.ply", "--sh-degree", "1")
    assert "SH degree 1, " in answer.out
    assert "lost: SH degree 2 to 1" in answer.out
    assert torch.equal(load_ply("out.ply").sh, load_ply(source).sh[:, :4])
    assert "lost nothing" in run("convert", source, "out.ply", "--sh-degree", "4").out


@pytest.mark.parametrize(("version", "start"), [("2", b"\x1f\x8b"), ("3", b"\x1f\x8b"), ("4", b"NGSP")])
def test_the_version_of_spz_is_chosen(run: RunCommand, source: Path, version: str, start: bytes) -> None:
    assert run("convert", source, "out.spz", "--spz-version", version).code == 0
    assert Path("out.spz").read_bytes().startswith(start)
    assert len(load_gaussians("out.spz")) == 60


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_level_of_ksplat_is_chosen(run: RunCommand, source: Path, level: int) -> None:
    answer = run("convert", source, "out.ksplat", "--ksplat-level", str(level))
    assert Path("out.ksplat").read_bytes()[20] == level
    assert ("rounded: colours, opacities\n" in answer.out) == (level == 0)
    assert len(load_gaussians("out.ksplat")) == 60


@pytest.mark.parametrize("out", ["map.ply", "sub/../map.ply", "link.ply"])
def test_the_input_is_not_overwritten(run: RunCommand, source: Path, out: str) -> None:
    Path("link.ply").symlink_to(source)
    before = source.read_bytes()
    assert_fix_named(run("convert", source, out), "is the input")
    assert source.read_bytes() == before


def test_the_folder_of_a_sog_is_not_overwritten_by_itself(run: RunCommand, source: Path) -> None:
    assert run("convert", source, "a_sog").code == 0
    assert_fix_named(run("convert", "a_sog", "a_sog"), "is the input")
    assert len(load_gaussians("a_sog")) == 60


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (["out.obj"], "no known format"),
        (["out.spz", "--sh-degree", "5"], "--sh-degree"),
        (["out.spz", "--sh-degree", "-1"], "--sh-degree"),
        (["out.ply", "--spz-version", "3"], "--spz-version"),
        (["out.ply", "--ksplat-level", "0"], "--ksplat-level"),
        (["folder.spz"], "OUT"),
        (["map.ply/out.spz"], "which is a file"),
    ],
)
def test_wrong_words_are_named_before_anything_is_read(
    run: RunCommand, source: Path, words: list[str], mistake: str
) -> None:
    Path("folder.spz").mkdir()
    before = sorted(Path().iterdir())
    assert_fix_named(run("convert", source, *words), mistake)
    assert sorted(Path().iterdir()) == before


def test_a_damaged_input_names_file_and_field(run: RunCommand, work_folder: Path) -> None:
    Path("bad.spz").write_bytes(b"NGSP" + bytes(10))
    assert_fix_named(run("convert", "bad.spz", "out.ply"), "bad.spz: header")
    assert not Path("out.ply").exists()


def test_a_run_folder_is_converted(run: RunCommand, source: Path) -> None:
    Path("run").mkdir()
    source.rename("run/map.ply")
    assert run("convert", "run", "desk.spz").code == 0
    assert len(load_gaussians("desk.spz")) == 60
