"""`splatbot batch`: words that are refused before any work, the report, and Ctrl-C."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.terminal import at_a_terminal
from tests.unit.batch.processes import item_processes, wait_until
from tests.unit.cli.conftest import RunCommand, assert_fix_named

LOG = "synthetic:tabletop?frames=10&width=160&height=120"


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["map"], "INPUT: is missing"),
        (["simulate", "--with", "frames", "2"], "INPUT: is missing"),
        (["simulate", "tabletop", "tabletopx"], "there is no scene 'tabletopx'"),
        (["map", LOG, "synthetic:tabletopx"], "there is no scene 'tabletopx'"),
        (["map", LOG, "/nowhere/log"], "/nowhere/log: log: does not exist"),
        (["map", "oak://"], "oak://: is a camera"),
        (["train", "/nowhere/photographs"], "/nowhere/photographs: INPUT: does not exist"),
        (["map", LOG, LOG], "2 items have the name"),
        (["map", LOG, "--with", "out", "here"], "--with: is 'out here'"),
        (["map", LOG, "--workers", "0"], "--workers: is 0"),
        (["map", LOG, "--workers", "2", "--ray", "local"], "--workers: excludes --ray"),
    ],
)
def test_wrong_words_are_refused_before_any_work(
    run: RunCommand, tmp_path: Path, words: list[str], problem: str
) -> None:
    assert_fix_named(run("batch", *words, "--out", tmp_path / "batch"), problem)
    assert not (tmp_path / "batch").exists()


@pytest.mark.parametrize("option", [["no-reprot"], ["max-frames", "many"], ["on-bad-frame", "skip", "jump"]])
def test_an_option_that_the_command_does_not_know_is_refused_before_any_work(
    run: RunCommand, tmp_path: Path, option: list[str]
) -> None:
    answer = run("batch", "map", LOG, "--out", tmp_path / "batch", "--with", *option)
    assert answer.code == 2
    assert option[-1] in answer.err
    assert not (tmp_path / "batch").exists()


def test_ray_at_a_place_without_a_cluster_is_an_error_at_once(run: RunCommand, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    for address in ("127.0.0.1:9", "somewhere"):
        answer = run("batch", "simulate", "tabletop", "--out", tmp_path, "--ray", address)
        assert_fix_named(answer, f"--ray: no cluster answers at '{address}'")


def test_ray_that_is_not_installed_is_named(run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    answer = run("batch", "simulate", "tabletop", "--out", tmp_path, "--ray", "local")
    assert_fix_named(answer, "pip install 'splatbot[cluster]'")


def test_the_report_has_a_row_for_each_item_of_the_folder(run: RunCommand, tmp_path: Path) -> None:
    size = ("--with", "frames", "2", "--with", "size", "64x48")
    assert run("batch", "simulate", "tabletop", "--out", tmp_path, *size).code == 0
    answer = run("batch", "simulate", "wall", "corridor", "--out", tmp_path, *size, "--with", "trajectory", "orbit")
    assert answer.code == 1
    assert "wall: finished" in answer.err
    assert "'orbit' does not fit" in answer.err
    rows = json.loads((tmp_path / "batch.json").read_text())["items"]
    assert [(row["name"], row["state"]) for row in rows] == [
        ("wall", "finished"),
        ("corridor", "failed"),
        ("tabletop", "finished"),
    ]
    with (tmp_path / "batch.csv").open(newline="") as file:
        assert [(row["name"], row["error"]) for row in csv.DictReader(file)] == [
            (row["name"], row["error"]) for row in rows
        ]
    for text in ("tabletop", "'orbit' does not fit", "batch.json"):
        assert text in answer.out


def test_scores_of_runs_and_trials_are_columns(run: RunCommand, tmp_path: Path) -> None:
    words = ("batch", "simulate", "desk=tabletop", "pick=wall", "--out", tmp_path, "--with", "list")
    assert run(*words, "--quiet").code == 0
    metrics = {"ate_rmse_m": 0.0123, "psnr_holdout_db": 30.25, "gaussians": 4512}
    (tmp_path / "desk" / "metrics.json").write_text(json.dumps(metrics))
    (tmp_path / "pick" / "trials.json").write_text(json.dumps({"stacks": [{"stack": "mesh", "success": 0.75}]}))
    answer = run(*words)
    for text in ("ATE RMSE", "12.30 mm", "30.2 dB", "4,512", "success mesh", "75 %"):
        assert text in answer.out
    rows = json.loads((tmp_path / "batch.json").read_text())["items"]
    assert (rows[0]["ate_rmse_m"], rows[0]["psnr_db"], rows[1]["success_mesh"]) == (0.0123, 30.25, 0.75)


def test_variables_that_results_depend_on_are_recorded_and_keys_are_not(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("SPLATBOT_MAPPING__HOLDOUT_EVERY", "SPLATBOT_SEED", "SPLATBOT_API_KEY", "SPLATBOT_DEBUG"):
        monkeypatch.setenv(name, "1")
    monkeypatch.setenv("SPLATBOT_ISA", "v2")
    assert run("batch", "simulate", "tabletop", "--out", tmp_path, "--with", "list").code == 0
    assert json.loads((tmp_path / "tabletop" / "item.json").read_text())["settings"] == {
        "SPLATBOT_ISA": "v2",
        "SPLATBOT_MAPPING__HOLDOUT_EVERY": "1",
        "SPLATBOT_SEED": "1",
    }
    monkeypatch.setenv("SPLATBOT_SEED", "2")
    answer = run("batch", "simulate", "tabletop", "--out", tmp_path, "--with", "list")
    assert_fix_named(answer, "the result of another command line: SPLATBOT_ISA=v2")


def test_ctrl_c_at_a_terminal_keeps_finished_items_and_leaves_no_process(tmp_path: Path) -> None:
    words = ["batch", "simulate", "wall", "tabletop", "room", "--out", str(tmp_path), "--workers", "1"]
    options = ["--with", "size", "320x240", "--with", "frames", "60"]
    shown = at_a_terminal(*words, *options, columns=80, interrupt_at="wall: finished")
    assert shown.code == 130, shown.text
    assert "Traceback" not in shown.text
    assert "interrupted; the same command continues" in " ".join(shown.text.split())
    assert item_processes(tmp_path) == []
    values = json.loads((tmp_path / "batch.json").read_text())
    assert values["interrupted"]
    states = [row["state"] for row in values["items"]]
    assert (states[0], states[-1]) == ("finished", "unfinished")  # a busy machine may finish the second one


def test_sigint_to_the_program_alone_ends_its_items(tmp_path: Path) -> None:
    words = [
        "batch",
        "simulate",
        "tabletop",
        "--out",
        str(tmp_path),
        "--with",
        "size",
        "64x48",
        "--with",
        "frames",
        "20000",
    ]
    with subprocess.Popen([sys.executable, "-m", "splatbot", *words], stderr=subprocess.PIPE, text=True) as program:
        wait_until(lambda: (tmp_path / "tabletop" / "rgb").exists())
        program.send_signal(signal.SIGINT)
        _, errors = program.communicate(timeout=60)
    assert program.returncode == 130, errors
    assert "Traceback" not in errors
    assert item_processes(tmp_path) == []
