"""`splatbot bench tracking` on a short synthetic log, and its peers on motions that are known."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.results import Results, Row
from splatbot.bench.tracking import ATE, BENCHMARK, LOST, NEES, NEES_AS_GIVEN, RESIDENT, RPE, TRACKED, TrackingSettings
from splatbot.bench.tracking.accuracy import run_log
from splatbot.bench.tracking.peers import TrackingPeer, tracking_peers
from splatbot.bench.tracking.plots import plot_tracking
from splatbot.cli import main
from splatbot.evaluation import absolute_error
from splatbot.frame import Frame
from splatbot.logs import open_log

LOG = "synthetic:tabletop?frames=8&width=320&height=240"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Results, Path]:
    """One comparison, for all tests."""
    folder = tmp_path_factory.mktemp("bench")
    config = folder / "config.yaml"
    config.write_text("mapping: {refine_iterations: 1}\n")
    return BENCHMARK.run(TrackingSettings(logs=(LOG,), out=folder, budgets=(100.0,), config=config)), folder


@pytest.mark.parametrize("peer", tracking_peers(), ids=lambda peer: peer.name)
def test_a_peer_follows_a_clean_log_to_centimetres(peer: TrackingPeer) -> None:
    log = open_log(LOG)
    outcome = run_log(log, peer.make())
    assert log.ground_truth is not None
    assert len(outcome.trajectory) == len(log)
    assert absolute_error(log.ground_truth, outcome.trajectory).rmse < 0.01


@pytest.mark.parametrize("peer", tracking_peers(), ids=lambda peer: peer.name)
def test_a_peer_without_texture_reports_no_pose_or_does_not_move(peer: TrackingPeer) -> None:
    log = open_log(LOG)
    odometry = peer.make()
    first = log[0]
    odometry.track(first)
    blank = Frame(1.0, np.zeros_like(first.rgb), np.zeros_like(first.depth), first.camera, 1)
    T = odometry.track(blank)
    assert T is None or np.allclose(T, np.eye(4), atol=1e-3)


def test_every_contender_has_error_share_times_and_memory(run: tuple[Results, Path]) -> None:
    results, _ = run
    for peer in (None, *(p.name for p in tracking_peers())):
        rows = {row.metric: row.value for row in results.rows if row.peer == peer}
        for metric in (ATE, RPE, "p50", "p95", "p99", RESIDENT):
            value = rows[metric]
            assert value is not None
            assert value > 0
        assert rows[TRACKED] == pytest.approx(100.0 * (8 - (rows[LOST] or 0)) / 8)
    ours = [row.value for row in results.rows if row.peer is None and row.metric == ATE]
    assert ours[0] is not None
    assert ours[0] < 2.0


def test_only_a_tracker_that_says_how_sure_it_is_has_a_nees(run: tuple[Results, Path]) -> None:
    results, _ = run
    (fitted,) = [row for row in results.rows if row.metric == NEES]
    assert (fitted.peer, fitted.value, fitted.note) == (None, None, "fewer than ten frames")
    (found,) = [row for row in results.rows if row.metric == NEES_AS_GIVEN]
    assert found.peer is None
    assert found.value is not None
    assert 0.05 < found.value < 3.0  # eight frames of 320x240 px share the errors of a keyframe or two


def test_logs_of_one_name_have_rows_of_their_own(tmp_path: Path) -> None:
    logs = tuple(f"{LOG}&seed={seed}" for seed in (0, 1))
    settings = TrackingSettings(logs=logs, out=tmp_path, budgets=(100.0,), no_peers=True, max_frames=3)
    found = BENCHMARK.run(settings)
    cases = [row.case for row in found.rows if row.metric == ATE]
    assert cases == ["tabletop, 100 ms", "tabletop #2, 100 ms"]


def test_files_hold_the_rows_the_machine_and_the_plot(run: tuple[Results, Path]) -> None:
    results, folder = run
    written = json.loads((folder / "tracking.json").read_text())
    assert set(written) == {"machine", "rows"}
    assert {"case", "metric", "value", "unit", "spread", "peer"} <= set(written["rows"][0])
    with (folder / "tracking.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(results.rows)
    assert (folder / "tracking.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_prints_the_table_and_writes_to_the_given_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = tmp_path / "figures.json"
    words = [
        "--out",
        str(tmp_path / "out"),
        "--json",
        str(where),
        "--no-peers",
        "--max-frames",
        "3",
        "--budgets",
        "100",
    ]
    assert main(["bench", "tracking", LOG, *words]) == 0
    assert "tabletop" in capsys.readouterr().out
    assert {row["peer"] for row in json.loads(where.read_text())["rows"]} == {None}


@pytest.mark.parametrize("words", [[], [LOG, "--max-frames", "1"], [LOG, "--budgets", "0"]])
def test_wrong_input_is_reported_before_anything_runs(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "tracking", *words]) == 2
    assert "Fix:" in capsys.readouterr().err


def test_cases_without_an_error_above_0_have_no_panel_and_do_not_end_the_benchmark(tmp_path: Path) -> None:
    stress = [
        Row("stress: corridor", ATE, 0.7, "mm"),
        Row("still, 100 ms", ATE, 0.0, "mm"),
        Row("still, 100 ms", "p50", 5.0, "ms"),
    ]
    plot_tracking(Results({}, stress), tmp_path)
    assert not list(tmp_path.iterdir())
    moving = [Row("desk, 100 ms", ATE, 3.0, "mm"), Row("desk, 100 ms", "p50", 40.0, "ms")]
    plot_tracking(Results({}, stress + moving), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"tracking.png", "tracking.svg"}
