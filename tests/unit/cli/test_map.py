"""`splatbot map`: output, files and refused input."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
import yaml

from splatbot.cli.progress import PlainLines, describe
from splatbot.config import Config
from splatbot.run import Progress
from splatbot.slam import FrameResult
from tests.unit.cli.conftest import RunCommand, assert_fix_named, assert_refused


def test_a_run_ends_with_a_summary_and_the_report(run: RunCommand, log_folder: Path, tmp_path: Path) -> None:
    answer = run("map", log_folder, "--out", tmp_path / "run")
    assert answer.code == 0
    for text in ("16 of 16", "ATE RMSE", "PSNR", "Gaussians", "time per frame", str(tmp_path / "run" / "report.html")):
        assert text in answer.out
    assert "frame 16/16" in answer.err
    assert (tmp_path / "run" / "report.html").exists()


def test_quiet_says_nothing(run: RunCommand, log_folder: Path, tmp_path: Path) -> None:
    answer = run("map", log_folder, "--out", tmp_path / "run", "--quiet")
    assert (answer.code, answer.out, answer.err) == (0, "", "")


def test_without_out_the_run_is_dated_and_latest_points_to_it(
    run: RunCommand, log_folder: Path, work_folder: Path
) -> None:
    for _ in range(2):  # the link is replaced, not tripped over
        assert run("map", log_folder, "--quiet").code == 0
    latest = work_folder / "runs" / "latest"
    assert latest.is_symlink()
    assert latest.resolve().name.startswith("log-")
    assert (latest / "metrics.json").exists()


def test_keys_and_files_and_environment_override_in_order(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("mapping: {max_gaussians: 1000, refine_iterations: 1}\nseed: 1\n")
    monkeypatch.setenv("SPLATBOT_MAPPING__REFINE_ITERATIONS", "2")
    monkeypatch.setenv("SPLATBOT_SEED", "2")
    answer = run("map", "--config", file, "--set", "seed=3", "--set", "mapping.holdout_every=4", "--dump-config")
    assert answer.code == 0
    values = yaml.safe_load(answer.out)
    assert values["seed"] == 3
    assert values["mapping"] == yaml.safe_load(Config().to_yaml())["mapping"] | {
        "max_gaussians": 1000,
        "refine_iterations": 2,
        "holdout_every": 4,
    }


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["--set", "mapping.max_gaussian=5"], "mapping.max_gaussian"),
        (["--set", "mapping.max_gaussians=-5"], "mapping.max_gaussians"),
        (["--set", "nothing"], "--set"),
        (["--set", "seed=[1"], "seed"),
        (["--max-frames", "0"], "--max-frames"),
        (["--config", "absent.yaml"], "absent.yaml"),
        (["--camera", "tum_fr9"], "tum_fr9"),
    ],
)
def test_wrong_options_are_named(
    run: RunCommand, log_folder: Path, tmp_path: Path, words: list[str], field: str
) -> None:
    assert_fix_named(run("map", log_folder, "--out", tmp_path / "run", *words), field)
    assert not (tmp_path / "run").exists()


def test_a_missing_log_is_named(run: RunCommand) -> None:
    answer = run("map")
    assert answer.code == 2
    assert "LOG" in answer.err


def test_a_bad_frame_stops_with_code_2_after_saving(run: RunCommand, log_folder: Path, tmp_path: Path) -> None:
    (log_folder / "rgb" / "000005.png").write_bytes(b"no image")
    answer = run("map", log_folder, "--out", tmp_path / "run")
    assert answer.code == 2
    assert "000005.png" in answer.err.splitlines()[-1]
    assert "5 of 16" in answer.out
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["tracked"] == 5


def test_a_bad_frame_can_be_skipped_and_is_mentioned(run: RunCommand, log_folder: Path, tmp_path: Path) -> None:
    (log_folder / "rgb" / "000005.png").write_bytes(b"no image")
    answer = run("map", log_folder, "--out", tmp_path / "run", "--on-bad-frame", "skip")
    assert answer.code == 0
    assert "1 skipped" in answer.out
    assert any(line.startswith("skipped:") and "000005.png" in line for line in answer.err.splitlines())


def test_ctrl_c_says_what_was_saved_and_exits_with_130(
    run: RunCommand, log_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    show = PlainLines.__call__

    def interrupting(self: PlainLines, progress: Progress) -> None:
        show(self, progress)
        if progress.phase == "mapping" and progress.done == 4:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(PlainLines, "__call__", interrupting)
    answer = run("map", log_folder, "--out", tmp_path / "run")
    assert answer.code == 130
    assert "interrupted; saved" in answer.out
    assert "4 of 16" in answer.out
    assert (tmp_path / "run" / "map.ply").exists()


def test_a_later_part_of_a_log_is_mapped_with_the_numbers_of_its_frames(
    run: RunCommand, log_folder: Path, tmp_path: Path
) -> None:
    words = ("map", log_folder, "--out", tmp_path / "run", "--no-report", "--first-frame", 6)
    answer = run(*words, "--max-frames", 5)
    assert answer.code == 0, answer.err
    assert "5 of 5" in answer.out
    rows = [json.loads(line) for line in (tmp_path / "run" / "frames.jsonl").read_text().splitlines()]
    assert [row["index"] for row in rows] == [6, 7, 8, 9, 10]
    assert_refused(run(*words[:-1], 16, "--overwrite"), "--first-frame: is 16. Fix: the frames of the log have")
    assert_refused(run("map", "--resume", tmp_path / "run", "--first-frame", 2), "--first-frame: is for a log")


@pytest.mark.parametrize(
    ("phase", "words"),
    [("refining", "mapped, refinement cut short; saved"), ("scoring", "mapped, scores and report cut short; saved")],
)
def test_a_signal_after_the_last_frame_is_named_by_the_phase_that_it_cut(
    run: RunCommand, log_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: str, words: str
) -> None:
    show = PlainLines.__call__

    def interrupting(self: PlainLines, progress: Progress) -> None:
        show(self, progress)
        if progress.phase == phase and progress.step == 0:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(PlainLines, "__call__", interrupting)
    answer = run("map", log_folder, "--out", tmp_path / "run", "--no-report")
    assert answer.code == 130
    assert words in answer.out
    assert "interrupted" not in answer.out
    assert "16 of 16" in answer.out


def at(done: int, verdict: str = "ok", elapsed: float = 0.0) -> Progress:
    result = FrameResult(index=done - 1, stamp=0.0, T_world_camera=None, verdict=verdict, gaussians=7)  # type: ignore[arg-type]
    return Progress("mapping", done, 100, elapsed, result=result, gaussians=7000, keyframes=2)


def test_plain_progress_is_a_line_every_two_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    lines = PlainLines(clock=lambda: now[0])
    for frame in range(1, 51):
        now[0] = 0.1 * frame
        lines(at(frame, elapsed=now[0]))
    shown = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in shown] == ["1/100", "21/100", "41/100"]
    assert "10.0 fps  7,000 Gaussians  2 keyframes  ok" in shown[-1]


def test_a_loss_is_shown_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    lines = PlainLines(clock=lambda: 0.0)
    for frame, verdict in enumerate(["ok", "ok", "lost", "lost", "ok"], 1):
        lines(at(frame, verdict))
    assert [line.split()[1] for line in capsys.readouterr().err.splitlines()] == ["1/100", "3/100", "5/100"]


def test_phases_after_the_frames_are_named() -> None:
    assert describe(Progress("scoring", 5, 5, 1.0), 0.0) == "scoring ..."


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--resume", "a", "--localise", "b"], "--resume"),
        (["--resume", "a", "--set", "seed=3"], "keeps its configuration"),
        (["--resume", "nowhere"], "nowhere: --resume: does not exist"),
        (["LOG", "--localise", "nowhere"], "nowhere: --localise: does not exist"),
    ],
)
def test_a_saved_run_that_cannot_be_used_is_reported_before_anything_is_written(
    run: RunCommand, work_folder: Path, words: list[str], what: str
) -> None:
    assert_fix_named(run("map", *words), what)
    assert list(work_folder.iterdir()) == []
