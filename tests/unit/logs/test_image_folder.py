"""Folders of images as Open3D, RealSense and ScanNet write them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import CameraError, InputError, LogError
from splatbot.frame import Frame
from splatbot.geometry import se3_exp, transform_points
from splatbot.logs import open_log
from splatbot.logs.image_folder import _COLOR, ImageFolderLog, _check_centre
from tests.unit.logs.published import Pose, encoded, text, write, write_open3d, write_scannet_export

Scene = tuple[list[Frame], list[Pose]]


@pytest.fixture
def open3d_folder(tmp_path: Path, scene: Scene) -> Path:
    return write_open3d(tmp_path / "desk", *scene)


@pytest.fixture
def scannet_folder(tmp_path: Path, scene: Scene) -> Path:
    return write_scannet_export(tmp_path / "scene0000_00", *scene)


def test_a_recording_of_open3d_is_read(open3d_folder: Path, scene: Scene) -> None:
    log = open_log(open3d_folder)
    assert (len(log), log.name, log.camera) == (6, "desk", scene[0][0].camera)
    for frame, exact in zip(log, scene[0], strict=True):
        np.testing.assert_array_equal(frame.rgb, exact.rgb)
        np.testing.assert_array_equal(frame.depth, exact.depth)
        assert frame.stamp == frame.index / 30
    assert log.ground_truth is None


@pytest.mark.parametrize("name", ["intrinsic.json", "camera_intrinsic.json"])
def test_the_depth_scale_of_the_intrinsics_applies(open3d_folder: Path, scene: Scene, name: str) -> None:
    values = json.loads((open3d_folder / "camera_intrinsic.json").read_text()) | {"depth_scale": 2000.0}
    (open3d_folder / "camera_intrinsic.json").unlink()
    write(open3d_folder / name, json.dumps(values))
    np.testing.assert_allclose(open_log(open3d_folder)[1].depth, scene[0][1].depth / 2, atol=1e-6)


def test_an_export_of_scannet_is_read(scannet_folder: Path, scene: Scene) -> None:
    log = open_log(scannet_folder)
    assert log.camera == scene[0][0].camera
    np.testing.assert_array_equal(log[3].depth, scene[0][3].depth)
    assert np.abs(log[3].rgb.astype(int) - scene[0][3].rgb).mean() < 3  # JPEG
    truth = log.ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, scene[1], atol=1e-9)


def test_colour_of_scannet_is_resampled_at_the_depth_pixels(tmp_path: Path) -> None:
    color, depth = Camera(130.0, 131.0, 66.0, 47.0, 132, 96), Camera(60.0, 61.0, 31.5, 23.5, 64, 48)
    T_color, T_depth = se3_exp([0.04, 0.0, 0.01, 0.0, 0.02, 0.0]), se3_exp([0.0, -0.02, 0.0, 0.01, 0.0, 0.0])
    v, u = np.mgrid[:96, :132]
    write(tmp_path / "color/0.png", encoded(np.stack([u, 2 * v, u], -1).astype(np.uint8)))
    write(tmp_path / "depth/0.png", encoded(np.full((48, 64), 1250, np.uint16)))
    for part, camera, T in (("color", color, T_color), ("depth", depth, T_depth)):
        K = np.eye(4)
        K[:3, :3] = camera.K
        write(tmp_path / f"intrinsic/intrinsic_{part}.txt", text(K))
        write(tmp_path / f"intrinsic/extrinsic_{part}.txt", text(T))
    frame = open_log(tmp_path)[0]
    assert frame.camera == depth
    points = depth.backproject(np.full((48, 64), 1.25, np.float32))
    uv = color.project(transform_points(T_color @ np.linalg.inv(T_depth), points))
    inside = ((uv > 3) & (uv < [128, 92])).all(-1)
    np.testing.assert_allclose(frame.rgb[inside][:, :2], uv[inside] * [1, 2], atol=1.6)


def test_numbers_pair_and_order_the_images(scannet_folder: Path) -> None:
    (scannet_folder / "color/0.jpg").rename(scannet_folder / "color/10.jpg")
    (scannet_folder / "depth/0.png").rename(scannet_folder / "depth/000010.png")
    (scannet_folder / "depth/3.png").unlink()
    (scannet_folder / "color/Thumbs.db").touch()
    log = open_log(scannet_folder)
    assert isinstance(log, ImageFolderLog)
    assert log.unpaired == 1
    assert [frame.stamp for frame in log] == [n / 30 for n in (1, 2, 4, 5, 10)]
    truth = log.ground_truth
    assert truth is not None
    assert len(truth) == 4  # the pose of 0 belongs to no frame


def test_timestamps_replace_the_rate(open3d_folder: Path) -> None:
    (open3d_folder / "depth/000001.png").unlink()
    (open3d_folder / "timestamps.txt").write_text("\n".join(f"{100 + n * n}.5" for n in range(6)))
    assert [frame.stamp for frame in open_log(open3d_folder)] == [100.5, 104.5, 109.5, 116.5, 125.5]


@pytest.mark.parametrize("lines", ["", "1\n2\n", "1\n2\n2\n3\n4\n5", "1\n2\nnan\n4\n5\n6", "1\n2\nx\n4\n5\n6", "\xff"])
def test_damaged_timestamps_are_refused(open3d_folder: Path, lines: str) -> None:
    (open3d_folder / "timestamps.txt").write_bytes(lines.encode("latin-1"))
    with pytest.raises(LogError, match=r"timestamps\.txt: stamps: .*Fix: write"):
        open_log(open3d_folder)


def test_two_images_of_one_number_are_refused(open3d_folder: Path) -> None:
    write(open3d_folder / "color/3.jpg", b"")
    with pytest.raises(LogError, match=r"3\.jpg: name: has the number of 000003\.png|000003\.png: name: .*3\.jpg"):
        open_log(open3d_folder)


def test_an_empty_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "color").mkdir()
    (tmp_path / "depth").mkdir()
    with pytest.raises(LogError, match=r"empty: 0 colour and 0 depth"):
        open_log(tmp_path)


def test_no_intrinsics_are_named_with_the_fix(open3d_folder: Path) -> None:
    (open3d_folder / "camera_intrinsic.json").unlink()
    with pytest.raises(CameraError, match=r"intrinsic\.json: camera: .*--camera FILE"):
        open_log(open3d_folder)


@pytest.mark.parametrize(
    "change",
    [
        {"intrinsic_matrix": [1, 2]},
        {"intrinsic_matrix": None},
        {"intrinsic_matrix": ["a"] * 9},
        {"intrinsic_matrix": [-5, 0, 0, 0, 5, 0, 1, 1, 1]},
        {"width": 0},
        {"height": "high"},
        {"depth_scale": 0},
    ],
)
def test_damaged_intrinsics_are_refused(open3d_folder: Path, change: dict[str, Any]) -> None:
    path = open3d_folder / "camera_intrinsic.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(CameraError, match=rf"{path}: .*Fix: "):
        open_log(open3d_folder)


@pytest.mark.parametrize(
    ("name", "content", "field"),
    [
        ("intrinsic_depth.txt", "1 2 3", "matrix"),
        ("intrinsic_color.txt", "nan " * 16, "fx"),
        ("extrinsic_color.txt", "nan " * 16, "extrinsic"),
        ("extrinsic_depth.txt", "3 0 0 0 0 3 0 0 0 0 3 0 0 0 0 1", "extrinsic"),
    ],
)
def test_damaged_matrices_of_scannet_are_refused(scannet_folder: Path, name: str, content: str, field: str) -> None:
    write(scannet_folder / "intrinsic" / name, content)
    with pytest.raises(InputError, match=f"{field}: .*Fix: "):
        open_log(scannet_folder)


def test_a_header_with_a_huge_size_is_refused_on_opening(scannet_folder: Path) -> None:
    path = scannet_folder / "depth/0.png"
    data = bytearray(path.read_bytes())
    data[16:24] = b"\x7f\xff\xff\xff" * 2
    path.write_bytes(data)
    with pytest.raises(CameraError, match="image size"):
        open_log(scannet_folder)


def test_one_damaged_image_spoils_its_frame_alone(scannet_folder: Path) -> None:
    path = scannet_folder / "color/0.jpg"
    path.write_bytes(path.read_bytes()[:-100])
    log = open_log(scannet_folder)
    with pytest.raises(LogError, match=rf"{path}: colour: .*truncated"):
        log.read(0)
    write(scannet_folder / "color/1.jpg", encoded(np.zeros((60, 80, 3), np.uint8), ".jpg"))
    with pytest.raises(LogError, match="colour size: is 80x60"):
        log.read(1)
    assert log.read(2).index == 2


def test_names_that_are_stamps_are_no_numbers(tmp_path: Path) -> None:
    names = [re.fullmatch(_COLOR, name) for name in ("1305031101.900000.png", "7.jpg", "frame-000012.png", "a.12.png")]
    assert [match and match["n"] for match in names] == [None, "7", "000012", "12"]


def test_intrinsics_of_another_image_size_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "intrinsic_color.txt"
    _check_centre(path, Camera(1170.0, 1170.0, 647.75, 483.75, 1296, 968))
    with pytest.raises(CameraError, match="centre at 648, 484 of images of 640x480"):
        _check_centre(path, Camera(1170.0, 1170.0, 647.75, 483.75, 640, 480))
