"""`splatbot eval`, `render`, `info` and `doctor`."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatbot.cli import checks
from splatbot.evaluation import depth_offset
from splatbot.gaussians import GaussianModel
from splatbot.geometry import pose_from_quat
from splatbot.logs import open_log
from splatbot.logs.record import record
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.unit.cli.conftest import RunCommand, assert_fix_named


def metrics_of(folder: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return values


def test_eval_finds_the_log_by_itself_and_agrees_with_the_run(
    run: RunCommand, run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    answer = run("eval", run_folder, "--json")
    assert answer.code == 0
    scores = json.loads(answer.out)
    for name in ("ate_rmse_m", "psnr_holdout_db", "depth_l1_m", "tracked", "gaussians"):
        assert scores[name] == pytest.approx(metrics_of(run_folder)[name], abs=1e-9), name


def test_eval_prints_a_table(run: RunCommand, run_folder: Path) -> None:
    answer = run("eval", run_folder)
    assert answer.code == 0
    for text in ("16 of 16", "ATE RMSE", "over 16 frames", "PSNR", "SSIM", "depth error"):
        assert text in answer.out


def test_eval_takes_another_reference(run: RunCommand, run_folder: Path, tmp_path: Path) -> None:
    estimate = Trajectory.load(run_folder / "trajectory.tum")
    bent = estimate.T_world_camera.copy()
    bent[8:, 1, 3] += 0.1
    Trajectory(estimate.stamps, bent).save(tmp_path / "bent.tum")
    answer = run("eval", run_folder, "--ground-truth", tmp_path / "bent.tum", "--json")
    assert json.loads(answer.out)["ate_rmse_m"] > 0.01


def test_eval_of_a_moved_log_says_what_to_do(run: RunCommand, run_folder: Path, log_folder: Path) -> None:
    moved = log_folder.rename(log_folder.with_name("moved"))
    answer = run("eval", run_folder)
    assert answer.code == 2
    assert str(log_folder) in answer.err
    assert run("eval", run_folder, "--log", moved).code == 0


def test_eval_of_something_else_is_refused(run: RunCommand, tmp_path: Path) -> None:
    answer = run("eval", tmp_path)
    assert answer.code == 2
    assert "metrics.json" in answer.err
    assert "splatbot map" in answer.err


@pytest.mark.parametrize("mode", ["rgb", "depth", "normal", "alpha"])
def test_render_writes_an_image_of_the_given_size(run: RunCommand, run_folder: Path, tmp_path: Path, mode: str) -> None:
    answer = run("render", run_folder, "--mode", mode, "--out", tmp_path / "view.png", "--size", "80x60")
    assert answer.code == 0
    image = cv2.imread(str(tmp_path / "view.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape[:2] == (60, 80)
    assert image.max() > 0


def test_render_without_out_names_the_picture_after_map_and_mode(
    run: RunCommand, run_folder: Path, work_folder: Path
) -> None:
    assert run("render", run_folder / "map.ply", "--mode", "depth").out.strip() == "map-depth.png"
    assert (work_folder / "map-depth.png").exists()


def test_render_takes_a_pose_by_hand_or_by_index(run: RunCommand, run_folder: Path, tmp_path: Path) -> None:
    pose = Trajectory.load(run_folder / "trajectory.tum").positions[6]
    by_hand = run("render", run_folder, "--out", tmp_path / "a.png", "--pose", *pose, 1, 0, 0, 0)
    by_index = run("render", run_folder, "--out", tmp_path / "b.png", "--index", 6)
    assert (by_hand.code, by_index.code) == (0, 0)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    other = run("render", run_folder, "--out", tmp_path / "c.png", "--pose", -0.5, -0.2, -1, 1, 0, 0, 0)
    assert other.code == 0
    assert (tmp_path / "a.png").read_bytes() != (tmp_path / "c.png").read_bytes()


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["--size", "80"], "--size"),
        (["--size", "0x60"], "--size"),
        (["--fov", "200"], "fov"),
        (["--index", "99"], "--index"),
        (["--pose", "0", "0", "0", "0", "0", "0", "0"], "--pose"),
        (["--video", "a.mp4", "--index", "1"], "--index"),
        (["--video", "a.mp4", "--seconds", "1e9"], "--seconds"),
        (["--video", "a.mp4", "--seconds", "nan"], "--seconds"),
        (["--pose", "0", "0", "0", "1", "0", "0", "0", "--index", "1"], "--pose"),
    ],
)
def test_render_refuses_what_it_cannot_draw(run: RunCommand, run_folder: Path, words: list[str], field: str) -> None:
    assert_fix_named(run("render", run_folder, *words), field)


@pytest.mark.parametrize(
    ("known", "up"),
    [
        (None, (0.0, -1.0, 0.0)),
        (Workspace(gravity=np.array([0.6, 0.0, -0.8])), (-0.6, 0.0, 0.8)),
        (Workspace(T_world_base=pose_from_quat((0, 0, 0), (0.5, 0.5, 0.5, 0.5))), (1.0, 0.0, 0.0)),
    ],
)
def test_render_from_a_point_shows_the_other_point_in_the_middle_and_up_as_up(
    run: RunCommand, tmp_path: Path, known: Workspace | None, up: tuple[float, ...]
) -> None:
    eye, at = np.array([0.7, -0.4, 0.2]), np.array([0.1, 0.2, 1.1])
    balls = np.stack([at, at + 0.2 * np.array(up)])
    GaussianModel.from_activated(
        means=balls,
        quats=np.tile([1.0, 0, 0, 0], (2, 1)),
        scales=np.full((2, 3), 0.01),
        opacities=np.full(2, 0.99),
        colors=np.eye(3)[:2],  # red, and green above it
    ).save(tmp_path / "map.ply")
    if known is not None:
        known.save(tmp_path / "scene.yaml")
    words = ("--look-from", *eye, "--look-at", *at, "--size", "161x121", "--out", tmp_path / "view.png")
    answer = run("render", tmp_path / "map.ply", *words)
    assert answer.code == 0, answer.err
    image = cv2.imread(str(tmp_path / "view.png"))
    assert image is not None
    (v, u), (v_up, u_up) = (np.argwhere(image[..., k] > 128).mean(axis=0) for k in (2, 1))
    np.testing.assert_allclose((u, v), (80, 60), atol=1.0)
    assert v_up < v - 3
    assert abs(u_up - u) < 2.0


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (("--look-from", 0, 0, 0), "--look-at: is missing next to --look-from"),
        (("--look-at", 0, 0, 0), "--look-from: is missing next to --look-at"),
        (("--look-from", 1, 2, 3, "--look-at", 1, 2, 3), "--look-at: is the point of --look-from"),
        (("--look-from", 0, 0, "nan", "--look-at", 1, 2, 3), "--look-from: is 0 0 nan"),
        (("--look-from", 0, 0, 0, "--look-at", 1, "inf", 3), "--look-at: is 1 inf 3"),
        (("--look-from", 0, -2, 1, "--look-at", 0, 0, 1), "--look-at: is straight above or below --look-from"),
        (("--look-from", 0, 0, 0, "--look-at", 0, 0, 1, "--index", 1), "--index: excludes --look-from and --look-at"),
        (("--look-from", 0, 0, 0, "--look-at", 0, 0, 1, "--video", "a.mp4"), "--look-from: is for a single view"),
    ],
)
def test_render_refuses_a_view_that_is_not_defined(
    run: RunCommand, run_folder: Path, work_folder: Path, words: tuple[object, ...], mistake: str
) -> None:
    assert_fix_named(run("render", run_folder, *words), mistake)
    assert not list(work_folder.iterdir())


@pytest.mark.parametrize("mode", ["rgb", "depth", "alpha"])
def test_render_writes_a_fly_through_of_the_given_length(
    run: RunCommand, run_folder: Path, tmp_path: Path, mode: str
) -> None:
    words = ["--video", tmp_path / "fly.mp4", "--seconds", "0.4", "--size", "80x60", "--mode", mode]
    assert run("render", run_folder, *words).code == 0
    video = cv2.VideoCapture(str(tmp_path / "fly.mp4"))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) == 10
    assert frames[0].shape == (60, 80, 3)
    assert all(frame.max() > 50 for frame in frames)


def test_a_fly_through_of_a_map_file_needs_a_trajectory(run: RunCommand, run_folder: Path, tmp_path: Path) -> None:
    assert_fix_named(run("render", run_folder / "map.ply", "--video", tmp_path / "a.mp4"), "--video")


@pytest.mark.parametrize("command", ["render", "info"])
def test_a_truncated_map_is_named(run: RunCommand, run_folder: Path, command: str) -> None:
    path = run_folder / "map.ply"
    path.write_bytes(path.read_bytes()[:-100])
    answer = run(command, path)
    assert_fix_named(answer, "map.ply")
    assert "Traceback" not in answer.err


def test_info_describes_a_log(run: RunCommand, log_folder: Path) -> None:
    answer = run("info", log_folder)
    assert answer.code == 0
    lines = {line.strip().partition("  ")[0]: line for line in answer.out.splitlines()}
    assert "16" in lines["frames"]
    assert "30.0 Hz" in lines["rate"]
    assert "64x48" in lines["image"]
    assert "16, path 15.00 cm" in lines["reference poses"]
    assert "99 %" in lines["valid depth"]  # 16 of 3072 pixels are a hole
    assert "not known" in lines["shift of depth onto colour"]


def test_info_tells_by_how_much_depth_lies_off_its_colour(run: RunCommand, tmp_path: Path) -> None:
    log = open_log("synthetic:room?frames=4")
    assert "0, 0 px" in run("info", "synthetic:room?frames=4").out
    off = [replace(frame, depth=np.roll(frame.depth, (-5, 4), (0, 1))) for frame in log]
    assert depth_offset(off) == (-4, 5)
    record(off, tmp_path / "off")
    assert "-4, 5 px: not well registered" in run("info", tmp_path / "off").out


def test_info_describes_a_map_and_a_run_by_its_map(run: RunCommand, run_folder: Path) -> None:
    by_run, by_map = run("info", run_folder), run("info", run_folder / "map.ply")
    assert by_run.code == 0
    assert by_run.out == by_map.out
    assert f"{metrics_of(run_folder)['gaussians']:,}" in by_run.out
    assert "4, 4, 4 mm" in by_run.out
    assert "0.95, 0.95, 0.95" in by_run.out


def test_info_of_nothing_is_named(run: RunCommand, tmp_path: Path) -> None:
    answer = run("info", tmp_path / "absent")
    assert answer.code == 2
    assert "absent" in answer.err


def test_doctor_fails_only_for_what_everything_needs(run: RunCommand, monkeypatch: pytest.MonkeyPatch) -> None:
    warn = checks.Finding("warn", "EGL", "absent", "install it")
    fail = checks.Finding("fail", "native module", "absent", "build it")
    monkeypatch.setattr(checks, "all_checks", lambda: [lambda: [warn]])
    answer = run("doctor")
    assert answer.code == 0
    assert "fix: install it" in answer.out
    monkeypatch.setattr(checks, "all_checks", lambda: [lambda: [warn], lambda: [fail]])
    assert run("doctor").code == 1


def test_doctor_names_a_missing_package_and_how_to_get_it() -> None:
    needed = checks._check_package(("no-such-distribution",), "")
    optional = checks._check_package(("no-such-distribution",), "grippers")
    assert (needed.state, optional.state) == ("fail", "warn")
    assert needed.fix == optional.fix == "pip install no-such-distribution"
    assert checks._check_package(("no-such-distribution", "numpy"), "").detail == np.__version__


def test_doctor_survives_graphics_that_hang_or_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(*args: Any, **kwargs: Any) -> Any:
        raise subprocess.TimeoutExpired("python", 60.0)

    monkeypatch.setattr(subprocess, "run", hang)
    (finding,) = checks.check_egl()
    assert (finding.state, "60 s" in finding.detail, "apt-get" in finding.fix) == ("warn", True, True)
    crashed = subprocess.CompletedProcess([], -11, stdout="", stderr="boom\ngladLoadGL error")
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: crashed)
    (finding,) = checks.check_egl()
    assert finding.state == "warn"
    assert "gladLoadGL error" in finding.detail


def test_doctor_reports_a_broken_rasterizer_instead_of_breaking(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "rasterizer_error", lambda: 0.5)
    assert checks.check_rasterizer()[0].state == "fail"
    monkeypatch.setattr(checks, "rasterizer_error", lambda: 1e-7)
    assert checks.check_rasterizer()[0].state == "ok"
