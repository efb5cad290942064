"""Sequences of 7-Scenes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.seven_scenes import SevenScenesLog
from tests.unit.logs.published import Pose, encoded, intrinsics, write, write_seven_scenes

Scene = tuple[list[Frame], list[Pose]]


@pytest.fixture
def folder(tmp_path: Path, scene: Scene) -> Path:
    """A sequence with the intrinsics of its images."""
    made = write_seven_scenes(tmp_path / "seq-01", *scene)
    write(made / "intrinsics.json", json.dumps(intrinsics(scene[0][0])))
    return made


def test_frames_depth_and_poses_are_read(folder: Path, scene: Scene) -> None:
    log = open_log(folder)
    frames, poses = scene
    assert (len(log), log.name) == (6, "seq-01")
    for frame, exact in zip(log, frames, strict=True):
        np.testing.assert_array_equal(frame.rgb, exact.rgb)
        np.testing.assert_array_equal(frame.depth, exact.depth)  # 65535 is missing too
        assert frame.stamp == frame.index / 30
    truth = log.ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, poses, atol=1e-9)
    np.testing.assert_array_equal(truth.stamps, [frame.stamp for frame in log])


def test_the_published_intrinsics_apply_without_others(tmp_path: Path) -> None:
    depth = np.full((480, 640), 1500, np.uint16)
    depth[:10] = 65535
    write(tmp_path / "frame-000007.color.png", encoded(np.full((480, 640, 3), 90, np.uint8)))
    write(tmp_path / "frame-000007.depth.png", encoded(depth))
    log = open_log(tmp_path)
    assert log.camera == Camera(585.0, 585.0, 320.0, 240.0, 640, 480)
    assert log[0].stamp == 7 / 30
    np.testing.assert_array_equal(log[0].depth[9:11, 0], np.array([0, 1.5], np.float32))
    assert log.ground_truth is None


def test_poses_that_are_not_finite_not_rigid_or_missing_are_left_out(folder: Path) -> None:
    bad = {0: "nan " * 16, 1: "-inf " * 16, 2: "-1.#IND " * 16, 3: "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"}
    for n, words in bad.items():
        (folder / f"frame-{n:06d}.pose.txt").write_text(words)
    (folder / "frame-000004.pose.txt").unlink()
    log = open_log(folder)
    truth = log.ground_truth
    assert len(log) == 6
    assert truth is not None
    assert truth.stamps.tolist() == [5 / 30]


@pytest.mark.parametrize("content", ["", "1 2 3", "one " * 16, "1 " * 40_000, "\x00\xff"])
def test_a_damaged_pose_is_named_and_the_frames_stay_readable(folder: Path, content: str) -> None:
    path = folder / "frame-000002.pose.txt"
    path.write_text(content, encoding="latin-1")
    log = open_log(folder)
    assert len(list(log)) == 6
    with pytest.raises(LogError, match=rf"{path}: matrix: .*16 numbers.*Fix: "):
        _ = log.ground_truth


def test_frames_without_a_partner_are_counted_and_numbers_order_the_frames(folder: Path) -> None:
    (folder / "frame-000001.depth.png").unlink()
    (folder / "frame-000003.color.png").unlink()
    for part in ("color.png", "depth.png", "pose.txt"):
        (folder / f"frame-000000.{part}").rename(folder / f"frame-1000000.{part}")
    log = open_log(folder)
    assert isinstance(log, SevenScenesLog)
    assert log.unpaired == 2
    assert [frame.stamp for frame in log] == [2 / 30, 4 / 30, 5 / 30, 1_000_000 / 30]


def test_two_files_of_one_number_are_refused(folder: Path) -> None:
    (folder / "frame-000001.depth.png").rename(folder / "frame-00002.depth.png")
    with pytest.raises(LogError, match=r"frame-00002\.depth\.png: name: .*frame-000002"):
        open_log(folder)


def test_a_number_that_stamps_cannot_hold_is_refused(folder: Path) -> None:
    (folder / "frame-000001.color.png").rename(folder / f"frame-{'9' * 40}.color.png")
    with pytest.raises(LogError, match="too many digits"):
        open_log(folder)


def test_a_sequence_without_depth_is_refused_as_empty(folder: Path) -> None:
    for path in folder.glob("*.depth.png"):
        path.unlink()
    with pytest.raises(LogError, match=r"empty: 6 colour and 0 depth.*Fix: "):
        open_log(folder)


def test_one_damaged_image_spoils_its_frame_alone(folder: Path) -> None:
    path = folder / "frame-000002.depth.png"
    path.write_bytes(path.read_bytes()[:-20])
    log = open_log(folder)
    with pytest.raises(LogError, match=rf"{path}: depth: .*truncated"):
        log.read(2)
    assert log.read(3).index == 3
    cv2.imwrite(str(path), np.full((120, 160), 65535, np.uint16))
    with pytest.raises(LogError, match="no valid depth"):
        log.read(2)
