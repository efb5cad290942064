"""map_log: its files, its scores, and no loss of computed results."""

from __future__ import annotations

import gc
import json
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.config import Config, load_config
from splatbot.errors import FormatError, InputError, LogError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.logs import Log, open_log
from splatbot.results.folder import RunFolder
from splatbot.results.rescore import rescore
from splatbot.run import Progress, map_log
from splatbot.run.state import SavedRun
from splatbot.trajectory import Trajectory
from tests.unit.oracle import OracleSlam

MakeLog = Callable[..., Path]

DESIGN_NAMES = {
    "frames", "tracked", "lost", "ate_rmse_m", "rpe_trans_rmse_m", "psnr_holdout_db", "depth_l1_m", "gaussians",
    "map_bytes", "peak_rss_bytes", "ms_per_frame", "stages", "effects",
}  # fmt: skip
FILES = {
    "config.yaml",
    "trajectory.tum",
    "frames.jsonl",
    "metrics.json",
    "map.ply",
    "audit.json",
    "report.html",
    "SHA256SUMS",
}


@pytest.fixture
def log(make_log: MakeLog) -> Log:
    return open_log(make_log(16))


def oracle(log: Log, **kwargs: Any) -> OracleSlam:
    assert log.ground_truth is not None
    return OracleSlam(log.ground_truth, **kwargs)


def read(folder: Path) -> dict[str, Any]:
    metrics: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return metrics


def truncate(path: Path, share: float = 0.5) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def interrupt_at(frame: int, times: int = 1) -> Callable[[Progress], None]:
    """Return a progress callback that acts as Ctrl-C once a number of frames is done."""

    def on_progress(progress: Progress) -> None:
        if progress.phase == "mapping" and progress.done == frame:
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGINT)

    return on_progress


def test_a_run_leaves_every_file_and_every_documented_metric(log: Log, tmp_path: Path) -> None:
    result = map_log(log, out=tmp_path / "run", slam=oracle(log))
    assert {p.name for p in (tmp_path / "run").iterdir()} == FILES
    assert read(tmp_path / "run") == result.metrics
    assert set(result.metrics) >= DESIGN_NAMES
    assert set(result.metrics["ms_per_frame"]) == {"p50", "p95", "p99"}
    assert result.exit_code == 0
    assert (result.metrics["frames"], result.metrics["tracked"], result.metrics["lost"]) == (16, 16, 0)
    assert result.metrics["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert result.metrics["gaussians"] == len(GaussianModel.load(tmp_path / "run" / "map.ply"))
    assert result.metrics["stages"]["track"]["p50"] == 2.0


def test_stages_without_time_and_skipped_gradients_are_reported(log: Log, tmp_path: Path) -> None:
    result = map_log(log, out=tmp_path / "run", slam=oracle(log, degraded=(6,)), report=False)
    lines = (tmp_path / "run" / "frames.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["skipped"] for line in lines[5:7]] == [[], ["features"]]
    assert result.metrics["skipped_gradients"] == 0


def test_held_out_frames_never_enter_the_map_and_are_scored(log: Log, tmp_path: Path) -> None:
    slam = oracle(log)
    result = map_log(log, out=tmp_path / "run", slam=slam, report=False)
    assert [index for index, hold_out in slam.seen if hold_out] == [7, 15]
    assert result.metrics["held_out"] == 2
    assert result.metrics["psnr_holdout_db"] > 0
    assert result.metrics["depth_median_m"] < 0.2  # the frames' planes lie within 15 cm


def test_no_frame_is_held_out_if_configured_so(log: Log, tmp_path: Path) -> None:
    config = load_config(overrides={"mapping.holdout_every": 0}, environ={})
    result = map_log(log, out=tmp_path / "run", slam=oracle(log), config=config, report=False)
    assert result.metrics["held_out"] == 0
    assert result.metrics["psnr_holdout_db"] is None


def test_the_trajectory_holds_the_tracked_frames_only(log: Log, tmp_path: Path) -> None:
    result = map_log(log, out=tmp_path / "run", slam=oracle(log, lost=(3, 4), degraded=(6,)), report=False)
    assert (result.metrics["tracked"], result.metrics["lost"], result.metrics["degraded"]) == (14, 2, 1)
    saved = Trajectory.load(tmp_path / "run" / "trajectory.tum")
    assert len(saved) == 14
    poses = RunFolder(tmp_path / "run").load_poses()
    assert 3 not in poses
    assert log.ground_truth is not None
    np.testing.assert_allclose(poses[5], log.ground_truth.T_world_camera[5], atol=1e-9)


def test_errors_are_null_without_a_reference(make_log: MakeLog, tmp_path: Path) -> None:
    folder = make_log(8)
    truth = open_log(folder).ground_truth
    assert truth is not None
    (folder / "groundtruth.txt").unlink()
    metrics = map_log(open_log(folder), out=tmp_path / "run", slam=OracleSlam(truth), report=False).metrics
    assert metrics["ate_rmse_m"] is None
    assert metrics["rpe_trans_rmse_m"] is None
    assert metrics["psnr_holdout_db"] is not None


def test_a_bad_frame_ends_the_run_and_the_map_is_saved(make_log: MakeLog, tmp_path: Path) -> None:
    folder = make_log(12)
    truncate(folder / "rgb" / "000009.png")
    log = open_log(folder)
    result = map_log(log, out=tmp_path / "run", slam=oracle(log))
    assert isinstance(result.error, LogError)
    assert result.exit_code == 2
    assert "000009.png" in str(read(tmp_path / "run")["error"])
    assert len(Trajectory.load(tmp_path / "run" / "trajectory.tum")) == 9
    assert len(GaussianModel.load(tmp_path / "run" / "map.ply")) > 0
    assert read(tmp_path / "run")["psnr_holdout_db"] is not None  # frame 7 was scored all the same
    assert "000009.png" in (tmp_path / "run" / "report.html").read_text()


def test_a_bad_frame_can_be_skipped(make_log: MakeLog, tmp_path: Path) -> None:
    folder = make_log(12)
    truncate(folder / "depth" / "000004.png")
    log = open_log(folder)
    told: list[str] = []
    result = map_log(
        log, out=tmp_path / "run", slam=oracle(log), on_bad_frame="skip", on_progress=lambda p: told.append(p.skipped)
    )
    assert result.exit_code == 0
    assert (result.metrics["frames"], result.metrics["skipped"]) == (11, 1)
    (skipped,) = [row for row in RunFolder(tmp_path / "run").load_frames() if row.verdict == "skipped"]
    assert skipped.index == 4
    assert "000004.png" in skipped.reasons[0]
    assert sum("000004.png" in text for text in told) == 1


def test_a_bad_first_frame_is_an_error_and_an_older_run_stays_as_it_was(make_log: MakeLog, tmp_path: Path) -> None:
    good = open_log(make_log(8))
    map_log(good, out=tmp_path / "run", slam=oracle(good), report=False)
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    folder = make_log(8, name="other")
    truncate(folder / "rgb" / "000000.png")
    with pytest.raises(LogError, match=r"000000\.png"):
        map_log(open_log(folder), out=tmp_path / "run", slam=oracle(good), report=False)
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before


def test_when_every_frame_is_bad_skipping_does_not_make_an_empty_run(make_log: MakeLog, tmp_path: Path) -> None:
    folder = make_log(3)
    for path in (folder / "rgb").iterdir():
        truncate(path)
    log = open_log(folder)
    with pytest.raises(LogError, match=r"000000\.png"):
        map_log(log, out=tmp_path / "run", slam=oracle(log), on_bad_frame="skip", report=False)
    assert not (tmp_path / "run").exists()


def test_a_damaged_reference_is_found_before_the_run_not_after(make_log: MakeLog, tmp_path: Path) -> None:
    folder = make_log(4)
    truth = open_log(folder).ground_truth
    assert truth is not None
    (folder / "groundtruth.txt").write_text("0.0 1 2\n")
    slam = OracleSlam(truth)
    with pytest.raises(FormatError, match=r"groundtruth\.txt"):
        map_log(open_log(folder), out=tmp_path / "run", slam=slam)
    assert not slam.seen


def test_ctrl_c_finishes_the_frame_and_saves_a_whole_run(log: Log, tmp_path: Path) -> None:
    handler = signal.getsignal(signal.SIGINT)
    slam = oracle(log)
    result = map_log(log, out=tmp_path / "run", slam=slam, on_progress=interrupt_at(10))
    assert result.exit_code == 130
    assert slam.loops_closed
    assert not slam.finished
    assert {p.name for p in (tmp_path / "run").iterdir()} == FILES
    metrics = read(tmp_path / "run")
    assert metrics["interrupted"] is True
    assert metrics["frames"] == 10
    assert metrics["psnr_holdout_db"] is not None
    assert len(Trajectory.load(tmp_path / "run" / "trajectory.tum")) == 10
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_second_ctrl_c_at_once_still_saves_the_map(log: Log, tmp_path: Path) -> None:
    result = map_log(log, out=tmp_path / "run", slam=oracle(log), on_progress=interrupt_at(10, times=2))
    assert result.exit_code == 130
    assert len(Trajectory.load(tmp_path / "run" / "trajectory.tum")) == 10
    assert len(GaussianModel.load(tmp_path / "run" / "map.ply")) > 0


def test_a_second_ctrl_c_gives_up_scoring_and_report_only(log: Log, tmp_path: Path) -> None:
    map_log(log, out=tmp_path / "run", slam=oracle(log), on_progress=interrupt_at(10, times=2))
    assert {p.name for p in (tmp_path / "run").iterdir()} == FILES - {"report.html", "audit.json"}
    assert read(tmp_path / "run")["psnr_holdout_db"] is None


@pytest.mark.parametrize("phase", ["mapping", "saving"])
def test_many_ctrl_c_in_a_frame_or_while_saving_lose_no_state(phase: str, log: Log, tmp_path: Path) -> None:
    def on_progress(progress: Progress) -> None:
        if progress.phase == phase and progress.done == 5:
            for _ in range(5):
                os.kill(os.getpid(), signal.SIGINT)

    limit = None if phase == "mapping" else 5
    map_log(log, out=tmp_path / "run", on_progress=on_progress, max_frames=limit, save_every=1e9, report=False)
    assert SavedRun.load(tmp_path / "run").place.next_index == 5
    assert read(tmp_path / "run")["interrupted"] is True


@pytest.mark.parametrize("threaded", [False, True])
def test_ctrl_c_while_refining_ends_that_only(threaded: bool, log: Log, tmp_path: Path) -> None:
    timers: list[threading.Timer] = []

    def on_progress(progress: Progress) -> None:
        if progress.phase == "refining" and not timers:
            timers.append(threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)))
            timers[0].start()

    endless = Config()
    endless.mapping.final_iterations, endless.mapping.holdout_every = 1_000_000, 2
    endless.mapping.threaded = threaded
    map_log(log, out=tmp_path / "run", config=endless, on_progress=on_progress, max_frames=4)
    metrics = read(tmp_path / "run")
    assert metrics["interrupted"] is True
    assert metrics["psnr_holdout_db"] is not None
    assert (tmp_path / "run" / "report.html").exists()


def test_ctrl_c_while_scoring_keeps_the_map(log: Log, tmp_path: Path) -> None:
    def on_progress(progress: Progress) -> None:
        if progress.phase == "scoring":
            os.kill(os.getpid(), signal.SIGINT)

    result = map_log(log, out=tmp_path / "run", slam=oracle(log), on_progress=on_progress)
    assert result.exit_code == 130
    assert read(tmp_path / "run")["interrupted"] is True
    assert {p.name for p in (tmp_path / "run").iterdir()} == FILES - {"report.html", "audit.json"}
    assert len(Trajectory.load(tmp_path / "run" / "trajectory.tum")) == 16


def test_ctrl_c_before_the_first_frame_is_just_an_interrupt(log: Log, tmp_path: Path) -> None:
    class Stopped(OracleSlam):
        def process(self, frame: Frame, *, hold_out: bool = False) -> Any:
            raise KeyboardInterrupt

    assert log.ground_truth is not None
    with pytest.raises(KeyboardInterrupt):
        map_log(log, out=tmp_path / "run", slam=Stopped(log.ground_truth))
    assert not (tmp_path / "run").exists()


def test_a_crash_of_the_slam_is_raised_after_the_map_is_saved(log: Log, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="crashed on purpose"):
        map_log(log, out=tmp_path / "run", slam=oracle(log, crash_at=6), report=False)
    assert len(Trajectory.load(tmp_path / "run" / "trajectory.tum")) == 6
    assert len(GaussianModel.load(tmp_path / "run" / "map.ply")) > 0


def test_a_folder_is_used_again_and_every_file_is_of_the_new_run(make_log: MakeLog, tmp_path: Path) -> None:
    for frames in (12, 8):
        log = open_log(make_log(frames, name=f"log{frames}"))
        map_log(log, out=tmp_path / "run", slam=oracle(log))
    assert len(RunFolder(tmp_path / "run").load_frames()) == 8
    assert "log8" in (tmp_path / "run" / "report.html").read_text()


def test_scoring_the_folder_again_gives_the_same_figures(log: Log, tmp_path: Path) -> None:
    metrics = map_log(log, out=tmp_path / "run", slam=oracle(log, lost=(5,)), report=False).metrics
    scores = rescore(RunFolder(tmp_path / "run"), log)
    assert scores["tracked"] == 15
    for name in ("ate_rmse_m", "rpe_trans_rmse_m", "psnr_holdout_db", "ssim_holdout", "depth_l1_m", "depth_median_m"):
        assert scores[name] == pytest.approx(metrics[name], abs=1e-9), name


def test_scoring_against_the_wrong_log_is_refused(log: Log, make_log: MakeLog, tmp_path: Path) -> None:
    map_log(log, out=tmp_path / "run", slam=oracle(log), report=False)
    with pytest.raises(FormatError, match="--log"):
        rescore(RunFolder(tmp_path / "run"), open_log(make_log(4, name="short")))


def test_a_lost_pose_file_is_noticed(log: Log, tmp_path: Path) -> None:
    map_log(log, out=tmp_path / "run", slam=oracle(log), report=False)
    lines = (tmp_path / "run" / "trajectory.tum").read_text().splitlines(keepends=True)
    (tmp_path / "run" / "trajectory.tum").write_text("".join(lines[:-1]))
    with pytest.raises(FormatError, match="checksum"):
        RunFolder(tmp_path / "run").load_poses()
    (tmp_path / "run" / "SHA256SUMS").unlink()  # as in runs of earlier versions
    with pytest.raises(FormatError, match="15 poses"):
        RunFolder(tmp_path / "run").load_poses()


@pytest.mark.long
def test_memory_does_not_grow_with_the_log(log: Log, tmp_path: Path) -> None:
    alive: list[weakref.ref[Frame]] = []
    most = 0

    class Watched(OracleSlam):
        def process(self, frame: Frame, *, hold_out: bool = False) -> Any:
            nonlocal most
            alive.append(weakref.ref(frame))
            gc.collect()
            most = max(most, sum(ref() is not None for ref in alive))
            return super().process(frame, hold_out=hold_out)

    assert log.ground_truth is not None
    map_log(log, out=tmp_path / "run", slam=Watched(log.ground_truth), report=False)
    assert most <= 2


def test_the_configuration_in_force_is_kept(log: Log, tmp_path: Path) -> None:
    config = load_config(overrides={"mapping.max_gaussians": 12345, "mapping.holdout_every": 4}, environ={})
    map_log(log, out=tmp_path / "run", slam=oracle(log), config=config, report=False)
    assert RunFolder(tmp_path / "run").load_config() == config != Config()


def test_max_frames_ends_the_run_early(log: Log, tmp_path: Path) -> None:
    assert map_log(log, out=tmp_path / "run", slam=oracle(log), max_frames=5, report=False).metrics["frames"] == 5


def test_a_folder_that_cannot_be_written_is_named_before_anything_is_computed(log: Log, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    slam = oracle(log)
    with pytest.raises(InputError, match="--out"):
        map_log(log, out=tmp_path / "file", slam=slam)
    assert not slam.seen


def test_progress_counts_frames_keyframes_and_losses(log: Log, tmp_path: Path) -> None:
    seen: list[Progress] = []
    map_log(log, out=tmp_path / "run", slam=oracle(log, lost=(2,)), on_progress=seen.append)
    mapping = [p for p in seen if p.phase == "mapping"]
    assert [p.done for p in mapping] == list(range(1, 17))
    assert (mapping[-1].lost, mapping[-1].keyframes) == (1, 13)
    phases = [p.phase for p in seen[16:]]
    assert [phase for phase, _ in groupby(phases)] == ["refining", "saving", "scoring", "reporting"]
    assert [(p.step, p.steps) for p in seen if p.phase == "scoring" and p.steps] == [(0, 2), (1, 2)]


def test_a_run_in_real_time_counts_dropped_and_late_frames(log: Log, tmp_path: Path) -> None:
    slow: list[int] = []

    class Slow(OracleSlam):
        def process(self, frame: Frame, *, hold_out: bool = False) -> Any:
            if len(self.seen) == 2:  # the third frame, unless a busy machine has dropped one before
                slow.append(frame.index)
                time.sleep(0.12)
            return super().process(frame, hold_out=hold_out)

    assert log.ground_truth is not None
    seen: list[Progress] = []
    slam = Slow(log.ground_truth)
    result = map_log(log, out=tmp_path / "run", slam=slam, rate=20.0, on_progress=seen.append)
    metrics = result.metrics
    assert metrics["dropped"] >= 1
    assert metrics["late"] >= 1
    assert metrics["frames"] + metrics["dropped"] == 16
    assert (seen[-1].late, seen[-1].dropped) == (metrics["late"], metrics["dropped"])
    rows = RunFolder(tmp_path / "run").load_frames()
    assert [row.index for row in rows] == list(range(16))
    assert [row.index for row in rows if row.verdict == "dropped"] == [i for i in range(16) if i not in dict(slam.seen)]
    assert rows[slow[0]].late
    assert "20 Hz" in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan")])
def test_an_invalid_rate_is_refused_before_a_frame_is_read(rate: float, log: Log, tmp_path: Path) -> None:
    slam = oracle(log)
    with pytest.raises(InputError, match="rate"):
        map_log(log, out=tmp_path / "run", slam=slam, rate=rate, report=False)
    assert not slam.seen


def test_a_frame_of_another_size_ends_the_run_or_is_left_out(log: Log, tmp_path: Path) -> None:
    class Strict(OracleSlam):
        def process(self, frame: Frame, *, hold_out: bool = False) -> Any:
            if frame.index == 7:
                raise InputError("is 80 x 60, frames before are 64 x 48.", file="frame 7", field="image size")
            return super().process(frame, hold_out=hold_out)

    assert log.ground_truth is not None
    stopped = map_log(log, out=tmp_path / "stop", slam=Strict(log.ground_truth), report=False)
    assert stopped.metrics["frames"] == 7
    assert stopped.exit_code == 2
    skipped = map_log(log, out=tmp_path / "skip", slam=Strict(log.ground_truth), on_bad_frame="skip", report=False)
    assert (skipped.metrics["frames"], skipped.metrics["skipped"], skipped.metrics["held_out"]) == (15, 1, 1)


def test_the_report_shows_a_page_of_the_map_where_one_is_made_and_says_why_not(
    log: Log, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    map_log(
        log, slam=oracle(log), out=tmp_path / "with", map_page=lambda model, path: f"<p>{len(model)} {len(path)}</p>"
    )
    words = (tmp_path / "with" / "map.html").read_text()
    assert words == f"<p>{len(GaussianModel.load(tmp_path / 'with' / 'map.ply'))} 16</p>"
    assert '<iframe src="map.html"' in (tmp_path / "with" / "report.html").read_text()

    def fails(model: GaussianModel, path: Trajectory) -> str:
        raise OSError("no port is free")

    map_log(log, slam=oracle(log), out=tmp_path / "without", map_page=fails)
    assert "no port is free" in caplog.text
    assert "iframe" not in (tmp_path / "without" / "report.html").read_text()
    assert not (tmp_path / "without" / "map.html").exists()
