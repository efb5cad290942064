"""`splatbot map` as a user runs it: sound logs, every kind of bad input, Ctrl-C. Nothing computed is ever lost."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.gaussians import GaussianModel
from splatbot.run.state import SavedRun
from splatbot.trajectory import Trajectory
from tests.e2e.conftest import COMMAND, N_FRAMES, metrics_of, splatbot_here

BAD = 6  # the frame that is damaged
NAMES = {"config.yaml", "trajectory.tum", "frames.jsonl", "metrics.json", "map.ply", "report.html", "map.html", "state"}
FILES = NAMES | {"SHA256SUMS", "audit.json"}
REPORT = {"report.html", "map.html", "audit.json"}


def truncated_png(log: Path) -> None:
    path = log / "rgb" / image(log, "rgb").name
    path.write_bytes(path.read_bytes()[:-2000])


def missing_depth_line(log: Path) -> None:
    lines = (log / "depth.txt").read_text().splitlines(keepends=True)
    (log / "depth.txt").write_text("".join(line for line in lines if image(log, "depth").name not in line))


def zero_depth(log: Path) -> None:
    cv2.imwrite(str(image(log, "depth")), np.zeros((240, 320), np.uint16))


def nan_depth(log: Path) -> None:
    old = image(log, "depth")
    new = old.with_suffix(".tiff")
    cv2.imwrite(str(new), np.full((240, 320), np.nan, np.float32))
    (log / "depth.txt").write_text((log / "depth.txt").read_text().replace(old.name, new.name))


def other_depth_size(log: Path) -> None:
    cv2.imwrite(str(image(log, "depth")), np.full((120, 160), 5000, np.uint16))


def image(log: Path, kind: str) -> Path:
    """Return the file of the frame to damage."""
    lines = [line for line in (log / f"{kind}.txt").read_text().splitlines() if not line.startswith("#")]
    return log / lines[BAD].split()[1]


@pytest.mark.parametrize(
    ("damage", "file", "field"),
    [
        (truncated_png, "rgb/", "colour"),
        (missing_depth_line, "depth.txt", "line"),
        (zero_depth, "depth/", "depth"),
        (nan_depth, ".tiff", "depth"),
        (other_depth_size, "depth/", "depth size"),
    ],
)
def test_a_bad_frame_names_file_field_and_fix_and_the_frames_before_it_are_kept(
    damage: Callable[[Path], None], file: str, field: str, log_copy: Path, tmp_path: Path
) -> None:
    damage(log_copy)
    answer = splatbot_here("map", log_copy, "--out", tmp_path / "run", "--no-report")
    assert answer.code == 2, answer.err
    assert "Traceback" not in answer.err
    message = answer.err.splitlines()[-1]
    assert message.startswith("error: ")
    place, _, rest = message.removeprefix("error: ").partition(": ")
    assert file in place
    assert field in rest.partition(" Fix: ")[0]
    assert rest.partition(" Fix: ")[2]
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES - REPORT
    metrics = metrics_of(tmp_path / "run")
    assert metrics["frames"] == metrics["tracked"] == BAD
    assert metrics["error"] in message
    assert len(Trajectory.load(tmp_path / "run" / "trajectory.tum")) == BAD
    assert len(GaussianModel.load(tmp_path / "run" / "map.ply")) == metrics["gaussians"] > 1000


def no_intrinsics(log: Path) -> None:
    (log / "intrinsics.json").unlink()


def no_frames(log: Path) -> None:
    for name in ("rgb.txt", "depth.txt"):
        (log / name).write_text("# nothing\n")


def torn_reference(log: Path) -> None:
    (log / "groundtruth.txt").write_text("0.0 1 2 3\n")


@pytest.mark.parametrize(
    ("damage", "file", "fix"),
    [
        (no_intrinsics, "intrinsics.json", "--camera tum_fr1"),
        (no_frames, "rgb.txt", "line"),
        (torn_reference, "groundtruth.txt", "remove the line"),
    ],
)
def test_a_log_that_cannot_be_mapped_is_refused_and_leaves_no_run(
    damage: Callable[[Path], None], file: str, fix: str, log_copy: Path, tmp_path: Path
) -> None:
    damage(log_copy)
    answer = splatbot_here("map", log_copy, "--out", tmp_path / "run")
    assert answer.code == 2
    assert answer.err.startswith("error: ")
    assert file in answer.err.partition(" Fix: ")[0]
    assert fix in answer.err.partition(" Fix: ")[2]
    assert "Traceback" not in answer.err
    assert not (tmp_path / "run" / "map.ply").exists()


@pytest.mark.parametrize("command", ["render", "info"])
def test_a_truncated_map_names_file_field_and_fix(command: str, sound_run: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.ply"
    path.write_bytes((sound_run / "map.ply").read_bytes()[:-1000])
    answer = splatbot_here(command, path)
    assert answer.code == 2
    assert answer.err.startswith(f"error: {path}: ")
    assert " Fix: " in answer.err
    assert "Traceback" not in answer.err


def test_a_sound_log_is_mapped_and_the_folder_is_all_that_is_needed(sound_run: Path) -> None:
    metrics = metrics_of(sound_run)
    assert {path.name for path in sound_run.iterdir()} == FILES
    assert (metrics["frames"], metrics["tracked"], metrics["lost"]) == (N_FRAMES, N_FRAMES, 0)
    assert metrics["ate_rmse_m"] < 0.005
    assert metrics["psnr_holdout_db"] > 18
    assert metrics["depth_median_m"] < 0.01
    evaluated = splatbot_here("eval", sound_run, "--json")
    assert evaluated.code == 0, evaluated.err
    scores = json.loads(evaluated.out)
    for name in ("ate_rmse_m", "rpe_trans_rmse_m", "psnr_holdout_db", "depth_l1_m"):
        assert scores[name] == pytest.approx(metrics[name], abs=1e-9), name


def test_the_map_is_rendered_near_to_what_the_camera_saw(sound_run: Path, sound_log: Path, tmp_path: Path) -> None:
    fov = 62.8  # of the synthetic camera
    out = tmp_path / "view.png"
    answer = splatbot_here("render", sound_run, "--index", 7, "--size", "320x240", "--fov", fov, "--out", out)
    assert answer.code == 0, answer.err
    rendered, seen = (cv2.imread(str(path)) for path in (out, sorted((sound_log / "rgb").iterdir())[7]))
    assert rendered is not None
    assert seen is not None
    mse = np.mean((rendered.astype(float) - seen.astype(float)) ** 2)
    assert 10 * np.log10(255**2 / mse) > 20


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
def test_an_interrupt_saves_what_was_mapped(sound_log: Path, tmp_path: Path, number: signal.Signals) -> None:
    process = start(sound_log, tmp_path / "run")
    wait_for_frame(process)
    process.send_signal(number)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + number
    assert "interrupted; saved" in out
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES
    metrics = metrics_of(tmp_path / "run")
    assert metrics["interrupted"] is True
    assert 1 <= metrics["frames"] < N_FRAMES
    assert len(Trajectory.load(tmp_path / "run" / "trajectory.tum")) == metrics["tracked"]
    assert len(GaussianModel.load(tmp_path / "run" / "map.ply")) == metrics["gaussians"]


@pytest.mark.long
def test_impatient_interrupts_lose_no_more_than_scores_and_report(sound_log: Path, tmp_path: Path) -> None:
    process = start(sound_log, tmp_path / "run")
    wait_for_frame(process)
    for _ in range(12):
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        time.sleep(0.03)
    process.communicate(timeout=120)
    assert process.returncode in (130, -signal.SIGINT)
    present = {path.name for path in (tmp_path / "run").iterdir() if not path.name.startswith(".")}
    assert present <= FILES
    assert present >= FILES - REPORT  # which the second gives up
    metrics = metrics_of(tmp_path / "run")
    assert len(Trajectory.load(tmp_path / "run" / "trajectory.tum")) == metrics["tracked"] > 0
    assert len(GaussianModel.load(tmp_path / "run" / "map.ply")) == metrics["gaussians"]
    assert SavedRun.load(tmp_path / "run").place.next_index == metrics["frames"]


def start(log: Path, out: Path) -> subprocess.Popen[str]:
    """Start a run that is slow enough to interrupt, with many refinement steps per keyframe."""
    slow = ("--set", "mapping.refine_iterations=60", "--set", "mapping.keyframe_translation=0.0001")
    return subprocess.Popen(
        [*COMMAND, "map", str(log), "--out", str(out), *slow],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_frame(process: subprocess.Popen[str]) -> None:
    """Wait until the first frame is mapped."""
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("frame 1/"):
            return
    pytest.fail("no frame was mapped")
