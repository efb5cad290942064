"""A run of several cameras is saved, resumed, localized, scored and audited, each frame at the pose of its camera."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from splatbot.config import Config
from splatbot.errors import FormatError, InputError
from splatbot.frame import Frame
from splatbot.logs import Log, open_log
from splatbot.logs.record import record
from splatbot.results.folder import RunFolder
from splatbot.results.observers import observers
from splatbot.results.rescore import rescore
from splatbot.results.views import raw_views
from splatbot.run import map_log
from splatbot.run.pacing import PacedSource
from splatbot.run.state import SavedRun
from splatbot.tracking.nearby_keyframes import pose_distance
from splatbot.training.datasets.run import run_dataset
from tests.rgbd import small_config
from tests.several_cameras import WRONG, FramesLog, estimated, frames_of, in_world, side_view, wrist_log

FRAMES = 14


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig of a moving camera, a fixed one with a wrong pose, and a free one."""
    folder = tmp_path_factory.mktemp("rig")
    wrist = wrist_log(FRAMES, width=160, height=120)
    record(wrist, folder / "wrist", ground_truth=wrist.ground_truth)
    T = side_view(wrist, np.radians(30), 0.1)
    stamps = [k / 30 + 0.01 for k in range(FRAMES)]
    record(FramesLog(frames_of(wrist, [T] * FRAMES, stamps, "", width=200, height=120)), folder / "table")
    record(FramesLog(frames_of(wrist, [*wrist.ground_truth.T_world_camera], stamps, "", width=160)), folder / "head")
    table = estimated(in_world(wrist, T) @ WRONG, fixed=True).model_dump(mode="json", exclude_unset=True)
    cameras = {"wrist": {"log": "wrist"}, "table": {"log": "table", **table}, "head": {"log": "head"}}
    (folder / "rig.yaml").write_text(yaml.safe_dump({"cameras": cameras}, sort_keys=False))
    return folder / "rig.yaml"


def config() -> Config:
    return small_config(mapping__holdout_every=7)


@pytest.fixture(scope="module")
def whole(rig: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of all frames."""
    out = tmp_path_factory.mktemp("whole")
    map_log(open_log(rig), out=out, config=config(), save_every=0.0)
    return out


def test_each_camera_has_its_poses_its_counts_and_its_pose_in_the_run_folder(whole: Path, rig: Path) -> None:
    run = RunFolder(whole)
    metrics = run.load_metrics()
    assert metrics["cameras"]["table"]["kind"] == "fixed"
    assert metrics["cameras"]["head"]["kind"] == "free"
    assert metrics["cameras"]["table"]["frames"] == metrics["cameras"]["head"]["frames"] == FRAMES
    trajectories = run.load_trajectories()
    assert {*trajectories} == {"", "table", "head"}
    for name, camera in metrics["cameras"].items():
        assert len(trajectories[name]) == camera["tracked"] > 0, name
    poses = trajectories["table"].T_world_camera
    wrist = wrist_log(FRAMES, width=160, height=120)
    assert pose_distance(poses[-1], in_world(wrist, side_view(wrist, np.radians(30), 0.1)))[0] < 5e-3
    assert np.allclose(poses, poses[0], atol=2e-3)
    assert np.allclose(metrics["cameras"]["table"]["pose"]["translation"], poses[-1][:3, 3], atol=1e-6)
    assert run.check()
    assert metrics["ate_rmse_m"] < 5e-3
    assert "table" in (whole / "report.html").read_text()


def test_frames_are_scored_and_audited_at_the_pose_of_their_camera(whole: Path, rig: Path) -> None:
    run, log = RunFolder(whole), open_log(rig)
    poses = run.load_poses()
    assert len(poses) == sum(len(trajectory) for trajectory in run.load_trajectories().values())
    indices, views = raw_views(run, log)
    names = {log[index].camera_name for index in indices}
    assert names == {"", "table", "head"}
    for index, (_, camera, T) in zip(indices, views, strict=True):
        assert camera.width == log[index].camera.width
        assert np.array_equal(T, poses[index])
    again, saved = rescore(run, log), run.load_metrics()
    for key in ("ate_rmse_m", "psnr_holdout_db", "depth_median_m"):
        assert again[key] == pytest.approx(saved[key], rel=1e-6), key
    assert json.loads((whole / "audit.json").read_text())["points_confirmed"] > 0


def test_every_camera_has_held_out_frames(whole: Path) -> None:
    held_out = [row.camera_name for row in RunFolder(whole).load_frames() if row.held_out]
    assert {name: held_out.count(name) for name in ("", "table", "head")} == {"": 2, "table": 2, "head": 2}


def test_a_rig_that_has_changed_since_the_run_is_refused(whole: Path, rig: Path, tmp_path: Path) -> None:
    cameras = yaml.safe_load(rig.read_text())["cameras"]
    for name in ("wrist", "table", "head"):
        cameras[name]["log"] = str(rig.parent / name)
    for changed in ({**cameras, "head": {**cameras["head"], "time_offset": 0.1}}, {"w": cameras["wrist"]}):
        (tmp_path / "rig.yaml").write_text(yaml.safe_dump({"cameras": changed}, sort_keys=False))
        with pytest.raises(FormatError, match="frames"):
            rescore(RunFolder(whole), open_log(tmp_path / "rig.yaml"))


def test_frames_of_each_camera_are_trained_with_their_own_size(whole: Path, rig: Path) -> None:
    data = run_dataset(whole, open_log(rig))
    assert {(view.camera.width, view.camera.height) for view in data.views} == {(160, 120), (200, 120), (160, 180)}
    for view in data.views:
        assert view.read().shape == (view.camera.height, view.camera.width, 3)


def test_observers_of_further_cameras_are_their_keyframes(whole: Path) -> None:
    run = RunFolder(whole)
    from splatbot.gaussians import GaussianModel

    model = GaussianModel.load(run.map)
    seen, poses = observers(run, model), run.load_poses()
    for row in run.load_frames():
        if row.keyframe and row.camera_name == "table":
            at = np.linalg.norm(seen - poses[row.index][:3, 3], axis=1) < 1e-4
            assert at.sum() > 50
            break
    else:
        pytest.fail("the fixed camera has no keyframe")


def test_a_resumed_run_of_several_cameras_is_bit_for_bit_the_uninterrupted_one(
    whole: Path, rig: Path, tmp_path: Path
) -> None:
    for frames in (9, 17, 30):  # while the fixed camera is estimated, before and after its keyframe
        resume = SavedRun.load(tmp_path) if frames > 9 else None
        given = {"resume": resume} if resume else {"config": config()}
        map_log(open_log(rig), out=tmp_path, max_frames=frames, save_every=0.0, report=False, **given)
    map_log(open_log(rig), out=tmp_path, resume=SavedRun.load(tmp_path), save_every=0.0, report=False)
    for name in ("trajectory.tum", "trajectory-table.tum", "trajectory-head.tum", "map.ply", "config.yaml"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes(), name


def test_frames_of_several_cameras_are_localized_in_the_saved_map(whole: Path, rig: Path, tmp_path: Path) -> None:
    saved = SavedRun.load(whole)
    size = saved.slam._mapper.size
    result = map_log(open_log(rig), out=tmp_path, localise=saved, report=False)
    assert result.metrics["cameras"]["table"]["tracked"] > 0
    assert result.metrics["gaussians"] == size


def test_a_run_is_not_resumed_with_another_camera_in_the_file(whole: Path, rig: Path, tmp_path: Path) -> None:
    cameras = yaml.safe_load(rig.read_text())["cameras"]
    for name in ("wrist", "table", "head"):
        cameras[name]["log"] = str(rig.parent / name)
    cameras = {"wrist": cameras["wrist"], "shelf": cameras["table"], "head": cameras["head"]}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump({"cameras": cameras}, sort_keys=False))
    with pytest.raises(InputError, match="other cameras than the run"):
        map_log(open_log(tmp_path / "rig.yaml"), out=tmp_path / "run", resume=SavedRun.load(whole), report=False)


def test_poses_of_a_camera_that_is_no_longer_there_leave_the_folder(rig: Path, tmp_path: Path) -> None:
    map_log(open_log(rig), out=tmp_path, config=config(), max_frames=6, report=False)
    assert (tmp_path / "trajectory-table.tum").exists()
    map_log(open_log(rig.parent / "wrist"), out=tmp_path, config=config(), max_frames=3, report=False)
    assert not [*tmp_path.glob("trajectory-*")]
    assert RunFolder(tmp_path).check()


def test_in_real_time_a_frame_is_dropped_for_a_newer_one_of_its_own_camera_alone() -> None:
    wrist = wrist_log(3, width=64, height=48)
    frames = [
        Frame(0.0, f.rgb, f.depth, f.camera, index, camera_name=name)
        for index, (f, name) in enumerate([(wrist[0], ""), (wrist[1], "table"), (wrist[2], "")])
    ]
    log: Log = FramesLog(frames)
    source = PacedSource(log, 3, rate=None)
    delivered = [arrival.index for arrival in source]
    assert delivered == [1, 2]
    assert source.dropped == [0]
