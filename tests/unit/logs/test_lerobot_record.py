"""LeRobot datasets that splatbot writes: its own reader, the layout, and the package lerobot where there is one."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.cli import main
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.base import LogBase
from splatbot.trajectory import Trajectory
from tests.unit.logs.published import Pose

pytest.importorskip("av", reason="av (extra lerobot) is not installed")
pytest.importorskip("pyarrow", reason="pyarrow (extra lerobot) is not installed")

import pyarrow.parquet as pq

from splatbot.logs.lerobot_record import record_lerobot

Scene = tuple[list[Frame], list[Pose]]
LEROBOT = os.environ.get("LEROBOT_PYTHON", "")  # an interpreter that has the package lerobot 0.6
_CHECK = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("local/check", root=sys.argv[1], depth_output_unit="m")
exact = np.load(sys.argv[2])
(depth,) = dataset.meta.depth_keys
(color,) = set(dataset.meta.camera_keys) - {depth}
assert len(dataset) == len(exact["rgb"]), len(dataset)
for n in range(len(dataset)):
    item = dataset[n]
    assert np.array_equal(item[depth].numpy()[0], exact["depth"][n])
    assert np.array_equal(np.rint(255 * item[color].numpy()).transpose(1, 2, 0), exact["rgb"][n])
    assert np.allclose(item["observation.state"].numpy(), exact["joints"][n], atol=1e-6)
    assert item["task"] == "move the camera"
assert np.allclose(np.ravel(dataset.meta.stats[color]["mean"]), exact["rgb"].mean((0, 1, 2)) / 255, atol=1e-6)
"""


class MovedLog(LogBase):
    """Frames in memory, with stamps of irregular steps, named joints and poses between the frames."""

    def __init__(self, frames: Sequence[Frame], truth: Trajectory | None = None) -> None:
        self.name, self.uri, self._frames, self.ground_truth = "moved", "memory", list(frames), truth

    @property
    def camera(self) -> Camera:
        return self._frames[0].camera

    def __len__(self) -> int:
        return len(self._frames)

    def _decode(self, index: int) -> Frame:
        return self._frames[index]


@pytest.fixture
def frames(scene: Scene) -> list[Frame]:
    """Frames at irregular times, with depth that is no multiple of a unit."""
    steps = [0.0, 0.03, 0.07, 0.1, 0.135, 0.17]
    return [
        replace(
            frame,
            stamp=1.7e9 + steps[k],
            depth=(frame.depth * np.float32(1.0001)),
            joints=np.array([0.1 * k, -0.3]),
            joint_names=("shoulder", "elbow"),
        )
        for k, frame in enumerate(scene[0])
    ]


def test_images_stamps_joints_and_poses_stay_the_same(tmp_path: Path, frames: list[Frame], scene: Scene) -> None:
    truth = Trajectory(np.array([f.stamp for f in frames]), np.stack(scene[1]))
    done: list[int] = []
    log = open_log(record_lerobot(MovedLog(frames, truth), tmp_path / "out", progress=done.append))
    assert done == [1, 2, 3, 4, 5, 6]
    assert log.camera == frames[0].camera
    for copy, exact in zip(log, frames, strict=True):
        assert copy.stamp == exact.stamp
        np.testing.assert_array_equal(copy.rgb, exact.rgb)
        np.testing.assert_array_equal(copy.depth, exact.depth)
        assert copy.joint_names == exact.joint_names
        assert copy.joints == pytest.approx(np.asarray(exact.joints), abs=1e-7)
    assert log.ground_truth is not None
    np.testing.assert_allclose(log.ground_truth.T_world_camera, scene[1], atol=1e-12)


def test_reference_poses_are_interpolated_to_the_frames(tmp_path: Path, frames: list[Frame]) -> None:
    stamps = frames[0].stamp + np.array([0.01, 0.06, 0.09, 0.12])
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = stamps - stamps[0]
    log = open_log(record_lerobot(MovedLog(frames, Trajectory(stamps, poses)), tmp_path / "out"))
    truth = log.ground_truth
    assert truth is not None
    assert truth.stamps.tolist() == [f.stamp for f in frames[1:4]]  # the others are before and after the poses
    np.testing.assert_allclose(truth.positions[:, 0], truth.stamps - stamps[0], atol=1e-6)


def test_the_layout_is_that_of_lerobot(tmp_path: Path, frames: list[Frame]) -> None:
    out = record_lerobot(MovedLog(frames), tmp_path / "out")
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_frames"], info["total_episodes"], info["fps"]) == ("v3.0", 6, 1, 29)
    depth = info["features"]["observation.images.camera_depth"]
    assert depth["info"] == {"is_depth_map": True, "depth_unit": "m"}
    assert depth["shape"] == [120, 160, 1]
    rows = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert set(rows.column_names) == set(info["features"])
    assert rows.column("timestamp").to_pylist() == pytest.approx([k / 29 for k in range(6)])
    image = rows.column("observation.images.camera_depth")[4].as_py()
    assert image["path"] == "frame-000004.tiff"
    np.testing.assert_array_equal(
        cv2.imdecode(np.frombuffer(image["bytes"], np.uint8), cv2.IMREAD_UNCHANGED), frames[4].depth
    )
    (episode,) = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (episode["dataset_from_index"], episode["dataset_to_index"], episode["length"]) == (0, 6, 6)
    stats = json.loads((out / "meta/stats.json").read_text())
    color = np.stack([f.rgb for f in frames]) / 255
    np.testing.assert_allclose(np.ravel(stats["observation.images.camera"]["mean"]), color.mean((0, 1, 2)))
    np.testing.assert_allclose(np.ravel(stats["observation.images.camera"]["std"]), color.std((0, 1, 2)), rtol=1e-6)
    assert stats["observation.state"]["max"] == pytest.approx([0.5, -0.3])
    assert np.shape(stats["observation.images.camera"]["min"]) == (3, 1, 1)


def test_lost_joints_masks_and_delays_are_counted(
    tmp_path: Path, frames: list[Frame], caplog: pytest.LogCaptureFixture
) -> None:
    frames[2] = replace(frames[2], joints=np.array([1.0]), joint_names=("elbow",))
    frames[3] = replace(frames[3], mask=np.ones((120, 160), bool), depth_delay=0.01)
    log = open_log(record_lerobot(MovedLog(frames), tmp_path / "out"))
    assert log[2].joints == pytest.approx([0.1 + 0.2 * 4 / 7, -0.3], abs=1e-6)  # between its neighbours
    for lost in ("joints of 1 frames", "masks of 1 frames", "delays of depth of 1 frames"):
        assert f"the {lost} are not written" in caplog.text
    late = [replace(frames[0], joints=None, joint_names=()), *frames[1:]]
    assert open_log(record_lerobot(MovedLog(late), tmp_path / "late"))[1].joints is None
    assert "the joints of 5 frames are not written" in caplog.text


def test_a_single_frame_and_joints_without_names_are_written(tmp_path: Path, frames: list[Frame]) -> None:
    one = replace(frames[0], joint_names=())
    copy = open_log(record_lerobot(MovedLog([one]), tmp_path / "out"))[0]
    assert (copy.stamp, copy.joint_names) == (one.stamp, ())
    assert copy.joints is not None


def test_another_camera_is_refused(tmp_path: Path, frames: list[Frame]) -> None:
    frames[4] = replace(frames[4], camera=replace(frames[4].camera, fx=99.0))
    with pytest.raises(LogError, match="the camera changed"):
        record_lerobot(MovedLog(frames), tmp_path / "out")


def test_the_command_writes_a_whole_dataset_or_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = "synthetic:tabletop?frames=3&width=64&height=48"
    out = tmp_path / "copy"
    assert main(["convert-log", log, str(out), "--layout", "lerobot"]) == 0
    assert f"{out}: 3 frames" in capsys.readouterr().out
    for a, b in zip(open_log(log), open_log(out), strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)
    assert main(["info", f"{out}?episode=0"]) == 0
    for words, message in (
        (["a.mcap"], "--layout"),
        (["a", "--depth-scale", "1000"], "--depth-scale"),
        (["copy"], "exists already"),
    ):
        target, *options = words
        assert main(["convert-log", log, str(tmp_path / target), "--layout", "lerobot", *options]) == 2
        assert message in capsys.readouterr().err
    (out / "data/chunk-000/file-000.parquet").write_bytes(b"")
    assert main(["convert-log", str(out), str(tmp_path / "next"), "--layout", "lerobot"]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


@pytest.mark.skipif(not LEROBOT, reason="LEROBOT_PYTHON names no interpreter with the package lerobot")
def test_the_package_lerobot_reads_the_same_frames(tmp_path: Path, frames: list[Frame], scene: Scene) -> None:
    truth = Trajectory(np.array([f.stamp for f in frames]), np.stack(scene[1]))
    out = record_lerobot(MovedLog(frames, truth), tmp_path / "out")
    joints = np.array([f.joints for f in frames])
    rgb, depth = np.stack([f.rgb for f in frames]), np.stack([f.depth for f in frames])
    np.savez(tmp_path / "exact.npz", rgb=rgb, depth=depth, joints=joints)
    command = [LEROBOT, "-P", "-c", _CHECK, str(out), str(tmp_path / "exact.npz")]
    offline = os.environ | {"HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, env=offline, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
