"""Scenes of Nerfstudio with depth, as logs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.transforms import TransformsLog
from tests.unit.logs.published import Pose, write_nerfstudio

Scene = tuple[list[Frame], list[Pose]]


@pytest.fixture
def folder(tmp_path: Path, scene: Scene) -> Path:
    return write_nerfstudio(tmp_path / "kitchen", *scene)


def change(folder: Path, **changes: Any) -> None:
    path = folder / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def change_frame(folder: Path, index: int, **changes: Any) -> None:
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    frames[index] |= changes
    change(folder, frames=frames)


def test_frames_poses_and_intrinsics_are_read_in_the_order_of_numbers(folder: Path, scene: Scene) -> None:
    frames, poses = scene
    log = open_log(folder)
    assert (len(log), log.name) == (6, "kitchen")
    np.testing.assert_allclose(log.camera.K, frames[0].camera.K, atol=1e-12)
    for frame, exact in zip(log, frames, strict=True):
        np.testing.assert_array_equal(frame.rgb, exact.rgb)
        np.testing.assert_array_equal(frame.depth, exact.depth)
        assert frame.stamp == frame.index / 30
    truth = log.ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, poses, atol=1e-9)


def test_names_that_are_seconds_are_stamps(folder: Path) -> None:
    for n in range(6):
        (folder / f"images/frame_{n:05d}.png").rename(folder / f"images/{5 + 0.25 * n:.2f}.png")
        change_frame(folder, 5 - n, file_path=f"images/{5 + 0.25 * n:.2f}.png")
    assert [frame.stamp for frame in open_log(folder)] == [5.0, 5.25, 5.5, 5.75, 6.0, 6.25]


def test_numbers_without_leading_zeros_are_in_their_order(folder: Path, scene: Scene) -> None:
    (folder / "images/frame_00001.png").rename(folder / "images/frame_10.png")
    change_frame(folder, 4, file_path="images/frame_10.png")
    np.testing.assert_array_equal(open_log(folder)[5].rgb, scene[0][1].rgb)


def test_the_unit_of_depth_is_that_of_the_file(folder: Path, scene: Scene) -> None:
    change(folder, depth_unit_scale_factor=0.0005)
    np.testing.assert_allclose(open_log(folder)[1].depth, scene[0][1].depth / 2, rtol=1e-6)


def test_distorted_images_are_undistorted(folder: Path) -> None:
    change(folder, k1=0.05, k2=-0.01)
    log = open_log(folder)
    assert log.calibration.camera.distortion == (0.05, -0.01, 0.0, 0.0, 0.0)
    assert log[0].camera.distortion == ()


def test_frames_without_depth_are_counted(folder: Path) -> None:
    change_frame(folder, 2, depth_file_path=None)
    log = open_log(folder)
    assert isinstance(log, TransformsLog)
    assert (len(log), log.unpaired) == (5, 1)


@pytest.mark.parametrize("path", ["../a.png", "/etc/passwd", "a/../../b.png", 7, None, "a\0b"])
def test_a_path_that_leaves_the_folder_is_refused(folder: Path, path: Any) -> None:
    change_frame(folder, 3, file_path=path)
    with pytest.raises(LogError, match=r"transforms\.json: frames\[3\]\.file_path: .*Fix: "):
        open_log(folder)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"fl_x": None}, "fl_x"),
        ({"fl_y": "a"}, "fl_y"),
        ({"w": 0}, "width"),
        ({"w": float("nan")}, "w"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model"),
        ({"camera_model": ["a"]}, "camera_model"),
        ({"is_fisheye": True}, "camera_model"),
        ({"k4": 0.01}, "camera_model"),
        ({"fl_x": 10**400}, "fl_x"),
        ({"depth_unit_scale_factor": 0}, "depth_unit_scale_factor"),
        ({"depth_unit_scale_factor": -1e-3}, "depth_unit_scale_factor"),
        ({"k1": "a"}, "k"),
        ({"frames": 3}, "frames"),
        ({"frames": [3]}, "frames"),
    ],
)
def test_damaged_values_are_refused(folder: Path, changes: dict[str, Any], field: str) -> None:
    path = folder / "transforms.json"
    path.write_text(json.dumps({"_": {"depth_file_path": ""}} | json.loads(path.read_text()) | changes))
    with pytest.raises(InputError, match=rf"{path}: {field}: .*Fix: "):
        open_log(folder)


@pytest.mark.parametrize("matrix", [None, [1, 2], [["a"] * 4] * 4, [[1] * 4, [1] * 3]])
def test_a_damaged_pose_is_refused_on_opening(folder: Path, matrix: Any) -> None:
    change_frame(folder, 3, transform_matrix=matrix)
    with pytest.raises(LogError, match=r"frames\[3\]\.transform_matrix: .*Fix: "):
        open_log(folder)


def test_poses_that_are_not_finite_are_left_out(folder: Path) -> None:
    change_frame(folder, 3, transform_matrix=[[float("nan")] * 4] * 4)
    truth = open_log(folder).ground_truth
    assert truth is not None
    assert len(truth) == 5


def test_frames_of_different_cameras_are_refused(folder: Path) -> None:
    change_frame(folder, 3, fl_x=99.0)
    with pytest.raises(InputError, match=r"intrinsics: differ between frames\. Fix: .*one camera"):
        open_log(folder)


def test_an_image_listed_twice_is_refused(folder: Path) -> None:
    change_frame(folder, 3, file_path="images/frame_00000.png")
    with pytest.raises(LogError, match="twice"):
        open_log(folder)


def test_a_missing_image_spoils_its_frame_alone(folder: Path) -> None:
    (folder / "depths/frame_00002.png").unlink()
    log = open_log(folder)
    with pytest.raises(LogError, match=r"frame_00002\.png: depth: .*No such file"):
        log.read(2)
    assert log.read(3).index == 3
