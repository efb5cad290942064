"""Scenes of COLMAP with depth, as logs; their bytes are written by the published layout."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.calibration import Calibration
from splatbot.logs.colmap import ColmapLog
from tests.unit.logs.published import Pose, write_colmap

Scene = tuple[list[Frame], list[Pose]]


@pytest.fixture
def folder(tmp_path: Path, scene: Scene) -> Path:
    return write_colmap(tmp_path / "kitchen", *scene)


@pytest.mark.parametrize("binary", [True, False])
def test_frames_poses_and_intrinsics_are_read_in_the_order_of_names(tmp_path: Path, scene: Scene, binary: bool) -> None:
    frames, poses = scene
    log = open_log(write_colmap(tmp_path / "kitchen", *scene, binary=binary))
    assert (len(log), log.name) == (6, "kitchen")
    np.testing.assert_allclose(log.camera.K, frames[0].camera.K, atol=1e-9)
    for frame, exact in zip(log, frames, strict=True):
        np.testing.assert_array_equal(frame.rgb, exact.rgb)
        np.testing.assert_array_equal(frame.depth, exact.depth)
        assert frame.stamp == frame.index / 30
    truth = log.ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, poses, atol=1e-9)


def test_names_that_are_seconds_are_stamps(tmp_path: Path, scene: Scene) -> None:
    folder = write_colmap(tmp_path / "kitchen", *scene, binary=False)
    model = folder / "sparse/0/images.txt"
    text = model.read_text()
    for n in range(6):
        name = f"1305031102.{175304 + n * 33000}"
        text = text.replace(f"frame{n:03d}.jpg", f"{name}.jpg")
        (folder / f"images/frame{n:03d}.jpg").rename(folder / f"images/{name}.jpg")
        (folder / f"depth/frame{n:03d}.png").rename(folder / f"depth/{name}.png")
    model.write_text(text)
    assert [frame.stamp for frame in open_log(folder)] == pytest.approx(
        [1305031102.175304 + 0.033 * n for n in range(6)], abs=1e-6
    )
    model.write_text(text.replace("1305031102.208304.jpg", "1305031102.1753040.jpg"))
    with pytest.raises(LogError, match="does not increase"):
        open_log(folder)


def test_the_unit_of_depth_is_that_of_the_address_or_of_the_camera_file(folder: Path, scene: Scene) -> None:
    np.testing.assert_allclose(open_log(f"{folder}?depth_scale=2000")[1].depth, scene[0][1].depth / 2, rtol=1e-6)
    given = Calibration(scene[0][0].camera, 500.0)
    np.testing.assert_allclose(open_log(folder, camera=given)[1].depth, scene[0][1].depth * 2, rtol=1e-6)
    for wrong in ("0", "-1", "nan", "far"):
        with pytest.raises(LogError, match="depth_scale"):
            open_log(f"{folder}?depth_scale={wrong}")


def test_distorted_images_are_undistorted(folder: Path, scene: Scene) -> None:
    c = scene[0][0].camera
    values = (c.fx, c.fy, c.cx + 0.5, c.cy + 0.5, 0.05, -0.01, 0.001, 0.0)
    data = struct.pack("<QIiQQ8d", 1, 1, 4, c.width, c.height, *values)  # 4: OPENCV
    (folder / "sparse/0/cameras.bin").write_bytes(data)
    log = open_log(folder)
    assert log.calibration.camera.distortion == (0.05, -0.01, 0.001, 0.0, 0.0)
    assert log[0].camera.distortion == ()


def test_images_without_depth_are_counted(folder: Path) -> None:
    (folder / "depth/frame002.png").unlink()
    log = open_log(folder)
    assert isinstance(log, ColmapLog)
    assert (len(log), log.unpaired) == (5, 1)
    assert [round(frame.stamp * 30) for frame in log] == [0, 1, 3, 4, 5]


def test_a_pose_without_a_rotation_gives_its_frame_no_reference(tmp_path: Path, scene: Scene) -> None:
    folder = write_colmap(tmp_path / "kitchen", *scene, binary=False)
    model = folder / "sparse/0/images.txt"
    lines = model.read_text().splitlines()
    words = lines[1].split()
    lines[1] = " ".join([words[0], "0", "0", "0", "0", *words[5:]])
    model.write_text("\n".join(lines))
    truth = open_log(folder).ground_truth
    assert truth is not None
    assert len(truth) == 5


@pytest.mark.parametrize("name", ["../a.jpg", "/etc/passwd", "a/../../b.jpg"])
def test_a_name_that_leaves_the_folder_is_refused(tmp_path: Path, scene: Scene, name: str) -> None:
    folder = write_colmap(tmp_path / "kitchen", *scene, binary=False)
    model = folder / "sparse/0/images.txt"
    model.write_text(model.read_text().replace("frame003.jpg", name))
    with pytest.raises(LogError, match=r"images\.txt: NAME: .*Fix: "):
        open_log(folder)


@pytest.mark.parametrize(
    ("lines", "field"),
    [
        ("1 OPENCV_FISHEYE 160 120 100 100 80 60 0.1 0 0 0\n", "MODEL"),
        ("2 PINHOLE 160 120 100 100 80 60\n", "cameras"),
        ("1 PINHOLE 160 120 -100 100 80 60\n", "fx"),
        ("1 PINHOLE 160 120 100\n", "line 1"),
    ],
)
def test_cameras_that_a_log_cannot_have_are_refused(tmp_path: Path, scene: Scene, lines: str, field: str) -> None:
    folder = write_colmap(tmp_path / "kitchen", *scene, binary=False)
    (folder / "sparse/0/cameras.txt").write_text(lines)
    with pytest.raises(InputError, match=rf"cameras\.txt: {field}.*Fix: "):
        open_log(folder)


def test_a_scene_without_depth_is_refused_with_the_way_to_train_it(folder: Path) -> None:
    (folder / "depth").rename(folder / "other")
    with pytest.raises(LogError, match="splatbot train"):
        open_log(folder)
