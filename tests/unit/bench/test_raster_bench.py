"""`splatbot bench raster` in its quick form."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from splatbot.bench.raster import BENCHMARK, RasterSettings
from splatbot.bench.raster.options import all_effects
from splatbot.bench.raster.speed import BACKWARD_FLOP, FORWARD_FLOP, scenes_of
from splatbot.bench.results import Results
from splatbot.cli import main


@pytest.fixture(scope="module")
def results(folder: Path) -> Results:
    """One quick run with peers, for all tests."""
    return BENCHMARK.run(RasterSettings(out=folder, peers=True, quick=True))


def figures(results: Results, case: str, peer: str | None = None) -> dict[str, Any]:
    """Return the values by metric."""
    return {row.metric: row.value for row in results.rows if row.case == case and row.peer == peer}


def test_every_scene_size_and_number_of_threads_is_measured(results: Results) -> None:
    for scene in scenes_of(RasterSettings(quick=True)):
        for threads in ("1 thread", "2 threads"):
            found = figures(results, f"{scene.name} 32x24, {threads}")
            for metric in ("forward", "forward+backward", "forward+pose backward", "evaluated pairs", "state memory"):
                assert found[metric] > 0.0


def test_files_hold_the_rows_and_the_machine(results: Results, folder: Path) -> None:
    written = json.loads((folder / "raster.json").read_text())
    assert set(written) == {"machine", "rows"}
    assert len(written["rows"]) == len(results.rows)
    assert {"case", "metric", "value", "unit", "spread", "peer"} <= set(written["rows"][0])
    assert written["machine"]["fma_peak_gflops"][written["machine"]["isa"]]["1"] > 1.0
    with (folder / "raster.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(results.rows)
    for name in ("raster-sweeps", "raster-growth"):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert b"<svg" in (folder / f"{name}.svg").read_bytes()


def test_ratios_are_those_of_the_measured_times(results: Results) -> None:
    compared = 0
    for row in results.rows:
        if row.metric.endswith(", ratio to splatbot") and row.value is not None:
            metric = row.metric.removesuffix(", ratio to splatbot")
            ours, theirs = results.find(row.case, metric), results.find(row.case, metric, row.peer)
            assert ours is not None
            assert theirs is not None
            assert row.value == pytest.approx(theirs / ours)
            compared += 1
    assert compared >= 8  # two peers, two scenes, two passes


def test_the_share_of_the_peak_follows_from_pairs_time_and_peak(results: Results) -> None:
    isa = results.machine["isa"]
    found = figures(results, "surface 32x24, 2 threads")
    peak = results.machine["fma_peak_gflops"][isa]["2"]
    for name, flop, stage in (("forward", FORWARD_FLOP, "blend"), ("backward", BACKWARD_FLOP, "blend_backward")):
        gflops = 1e-6 * flop * found["evaluated pairs"] / found[f"stage {stage}"]
        assert found[f"blend {name}, share of FMA peak"] == pytest.approx(100.0 * gflops / peak)
        assert 0.0 < gflops < peak


def test_peers_show_the_same_image_and_gradients(results: Results) -> None:
    for case in ("surface 32x24, 1 thread, RGB", "random 500 32x24, 1 thread, RGB"):
        for peer in ("torch", "scalar C++"):
            found = figures(results, case, peer)
            assert found["image, error of 99.9 % of the pixels"] < 1e-4
            assert found["gradients, largest relative difference"] < 1e-3


def test_an_absent_peer_is_said_to_be_absent(results: Results) -> None:
    notes = {row.peer: row.note for row in results.rows if row.metric == "implementation"}
    assert set(notes) == {"torch", "scalar C++", "gsplat torch reference"}
    assert all(notes.values())


def test_every_effect_has_a_line_with_figures_or_a_reason(results: Results) -> None:
    for effect in all_effects():
        rows = results.select(f"effect on surface 32x24: {effect.name}")
        assert rows
        assert all(row.value is not None or row.note for row in rows)


def test_an_instruction_set_is_compared_with_float64(results: Results) -> None:
    for name in results.machine["fma_peak_gflops"]:
        assert figures(results, f"sweep instruction set: {name}")["largest error"] < 1e-5


def test_the_command_prints_its_tables_and_writes_to_the_given_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code = main(
        ["bench", "raster", "--quick", "--out", str(out), "--json", str(tmp_path / "more.json"), "--threads", "1"]
    )
    assert code == 0
    assert "Error over time" in capsys.readouterr().out
    assert json.loads((tmp_path / "more.json").read_text()) == json.loads((out / "raster.json").read_text())


def test_a_number_of_threads_that_makes_no_sense_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "raster", "--quick", "--threads", "0"]) == 2
    assert "--threads" in capsys.readouterr().err
