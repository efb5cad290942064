"""Blender, Nerfstudio and instant-ngp scenes."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from splatbot.errors import FormatError, LogError, SplatbotError
from splatbot.training.datasets import TrainingView, open_dataset
from tests.unit.training.datasets.scenes import (
    CAMERA_PARAMS,
    HEIGHT,
    RAYS,
    WIDTH,
    mark_centers,
    marks_image,
    transforms_scene,
)


def distance_of_axis_from_origin(view: TrainingView) -> float:
    """Return the distance of the origin from the ray through the centre of the image; infinite behind the camera."""
    center, axis = view.T_world_camera[:3, 3], view.T_world_camera[:3, 2]
    along = float(-center @ axis)
    return float(np.linalg.norm(center + along * axis)) if along > 0 else np.inf


def test_cameras_of_blender_look_at_the_object_with_its_top_up(data_root: Path) -> None:
    data = open_dataset(data_root / "blender_lego_400")
    assert (data.kind, len(data.views), len(data.points)) == ("blender", 100, 0)
    for view in data.views:
        assert distance_of_axis_from_origin(view) < 0.2
        assert view.T_world_camera[2, 1] <= 1e-6  # y of the image points down
        assert np.linalg.det(view.T_world_camera[:3, :3]) == pytest.approx(1.0)
    angle = json.loads((data_root / "blender_lego_400" / "transforms_train.json").read_text())["camera_angle_x"]
    camera = data.views[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (400, 400, 199.5, 199.5)
    assert camera.fx == camera.fy == pytest.approx(200 / np.tan(angle / 2))


def test_images_of_blender_have_alpha_and_show_the_object_in_the_middle(data_root: Path) -> None:
    image = open_dataset(data_root / "blender_lego_400", scale=4).views[3].read()
    assert image.shape == (100, 100, 4)
    assert image[40:60, 40:60, 3].mean() > 250
    assert image[:5, :5, 3].max() == 0


def test_views_of_the_blender_test_and_validation_files_are_held_out(tmp_path: Path) -> None:
    for part in ("train", "test", "val"):
        transforms_scene(tmp_path, f"transforms_{part}.json", frames=2)
    train, held_out = open_dataset(tmp_path).split()
    assert [view.name for view in train] == ["train/r_0.png", "train/r_1.png"]
    assert [view.name for view in held_out] == ["test/r_0.png", "test/r_1.png", "val/r_0.png", "val/r_1.png"]


def test_missing_frames_of_instant_ngp_are_skipped_with_one_warning(
    data_root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        data = open_dataset(data_root / "instant_ngp_fox")
    assert [record.getMessage().rpartition(": ")[2] for record in caplog.records] == ["17 of 67 images are missing"]
    assert (data.kind, len(data.views)) == ("nerfstudio", 50)


def test_photographs_of_instant_ngp_are_undistorted_with_its_intrinsics(data_root: Path) -> None:
    view = open_dataset(data_root / "instant_ngp_fox", scale=4).views[0]
    np.testing.assert_allclose(view.camera.K_corner[:2].ravel()[[0, 2, 4, 5]] * 4, [1375.52, 554.558, 1374.49, 965.268])
    assert view.read().shape == (480, 270, 3)
    assert view.read_mask is not None
    assert 0 < view.read_mask().mean() < 0.1


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("per_frame", [False, True])
def test_marks_lie_at_their_pinhole_projections(tmp_path: Path, model: str, per_frame: bool) -> None:
    params = list(CAMERA_PARAMS[model])
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
    keys = {"OPENCV": ["k1", "k2", "p1", "p2"], "OPENCV_FISHEYE": ["k1", "k2", "k3", "k4"]}.get(model, [])
    intrinsics: dict[str, Any] = dict(zip(["fl_x", "fl_y", "cx", "cy", *keys], params, strict=True))
    intrinsics |= {"w": WIDTH, "h": HEIGHT, "camera_model": model}
    content = transforms_scene(tmp_path, frames=1, **({} if per_frame else intrinsics))
    if per_frame:
        content["frames"][0] |= intrinsics
        (tmp_path / "transforms.json").write_text(json.dumps(content))
    cv2.imwrite(str(next(tmp_path.rglob("r_0.png"))), marks_image(camera.img_from_cam(RAYS) - 0.5))
    view = open_dataset(tmp_path).views[0]
    pixels = view.camera.project(RAYS)
    np.testing.assert_allclose(mark_centers(view.read(), pixels, 8), pixels, atol=0.2)


def test_point_cloud_of_nerfstudio_comes_with_its_colours(tmp_path: Path) -> None:
    transforms_scene(tmp_path, ply_file_path="points.ply", applied_transform=[[1, 0, 0, 0]])
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {a}\n" for a in "xyz")
    colors = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    (tmp_path / "points.ply").write_text(f"{header}{colors}end_header\n1 2 3 4 5 6\n-1 0 0.5 255 0 7\n")
    data = open_dataset(tmp_path)
    np.testing.assert_array_equal(data.points, [[1, 2, 3], [-1, 0, 0.5]])
    np.testing.assert_array_equal(data.point_colors, [[4, 5, 6], [255, 0, 7]])
    (tmp_path / "points.ply").write_text(f"{header}end_header\n1 2 3\n-1 0 0.5\n")
    assert (open_dataset(tmp_path).point_colors == 128).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "ply_file_path: cannot be read"),
        ("not a ply", "is damaged"),
        ("ply\nformat ascii 1.0\nelement face 0\nend_header\n", "is no point cloud"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "is no point cloud"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            "end_header\n1 nan 2\n",
            "vertex 0: holds NaN",
        ),
        (
            "ply\nformat binary_little_endian 1.0\nelement vertex 99999999999999\nproperty double x\nend_header\n",
            "the header claims",
        ),
    ],
)
def test_damaged_point_cloud_is_named(tmp_path: Path, text: str | None, message: str) -> None:
    transforms_scene(tmp_path, ply_file_path="points.ply")
    if text is not None:
        (tmp_path / "points.ply").write_text(text)
    with pytest.raises(FormatError, match=rf"points\.ply: .*{message}|points\.ply: {message}"):
        open_dataset(tmp_path)


def test_views_that_nerfstudio_lists_for_tests_are_held_out(tmp_path: Path) -> None:
    content = transforms_scene(tmp_path)
    paths = [frame["file_path"] + ".png" for frame in content["frames"]]
    for frame, path in zip(content["frames"], paths, strict=True):
        frame["file_path"] = path
    (tmp_path / "transforms.json").write_text(json.dumps(content | {"test_filenames": [paths[1]]}))
    data = open_dataset(tmp_path)
    assert data.held_out_names == (data.views[1].name,)


def test_images_next_to_the_folder_of_the_scene_open_under_a_name_inside_of_it(tmp_path: Path) -> None:
    content = transforms_scene(tmp_path / "images")
    for frame in content["frames"]:
        frame["file_path"] = "../images/" + frame["file_path"]
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    data = open_dataset(tmp_path / "scene")
    assert data.views[1].name == "images/transforms/r_1.png"
    assert (data.views[1].read() == 40).all()


def test_scene_without_any_image_is_refused(tmp_path: Path) -> None:
    transforms_scene(tmp_path)
    for file in tmp_path.rglob("*.png"):
        file.unlink()
    with pytest.raises(LogError, match=r"transforms\.json: frames: lists 3 images, of which none exists"):
        open_dataset(tmp_path)


def rotation(change: Callable[[NDArray[np.float64]], Any]) -> Callable[[dict[str, Any]], Any]:
    """Return a change of the matrix of the second frame."""

    def apply(content: dict[str, Any]) -> None:
        frame = content["frames"][1]
        frame["transform_matrix"] = np.asarray(change(np.array(frame["transform_matrix"]))).tolist()

    return apply


def frame_value(key: str, value: Any) -> Callable[[dict[str, Any]], Any]:
    """Return a change of a value of the second frame."""
    return lambda content: content["frames"][1].update({key: value})


DAMAGE: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no frames": (lambda c: c.pop("frames"), "frames: is no list"),
    "frames are numbers": (lambda c: c.update(frames=[1, 2]), "frames: is no list of dict"),
    "empty frames": (lambda c: c.update(frames=[]), "frames: lists 0 images"),
    "no path": (frame_value("file_path", None), r"frames\[1\].file_path"),
    "path is a number": (frame_value("file_path", 3), r"frames\[1\].file_path"),
    "twice": (lambda c: c["frames"].append(c["frames"][0]), "name: has the image .* twice"),
    "no matrix": (frame_value("transform_matrix", None), r"frames\[1\].transform_matrix: is no matrix"),
    "matrix is ragged": (frame_value("transform_matrix", [[1], [1, 2]]), "is no matrix"),
    "matrix is text": (frame_value("transform_matrix", "abc"), "is no matrix"),
    "matrix holds NaN": (rotation(lambda T: T * np.nan), "is no matrix"),
    "matrix is scaled": (rotation(lambda T: T * 1.01), "is not rigid"),
    "matrix mirrors": (rotation(lambda T: T @ np.diag([-1.0, 1, 1, 1])), "determinant -1"),
    "matrix is singular": (rotation(lambda T: T @ np.diag([0.0, 1, 1, 1])), "is not rigid"),
    "last row": (rotation(lambda T: T + np.eye(4)[[3]].T @ np.ones((1, 4))), "is not rigid"),
    "no focal length": (lambda c: c.pop("camera_angle_x"), r"fl_x: is missing"),
    "angle is negative": (lambda c: c.update(camera_angle_x=-1), "camera_angle_x: is -1"),
    "focal length is text": (lambda c: c.update(fl_x="long"), "fl_x: is 'long'"),
    "focal length is infinite": (lambda c: c.update(fl_x=float("inf")), "fl_x: is inf"),
    "focal length is huge": (lambda c: c.update(fl_x=10**400), "fl_x: is 1000"),
    "focal length is negative": (lambda c: c.update(fl_x=-5), "fx: is -5"),
    "width is broken": (lambda c: c.update(w=160.5, h=120), "w, h: are 160.5, 120"),
    "width is negative": (lambda c: c.update(w=-160, h=120), "-160x120"),
    "width is another": (lambda c: c.update(w=80, h=60), "is 160x120, its camera is 80x60"),
    "model is unknown": (lambda c: c.update(camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR'; supported are"),
    "k4 without fisheye": (lambda c: c.update(k4=0.1), "k4: is 0.1"),
    "point cloud is a number": (lambda c: c.update(ply_file_path=3), "ply_file_path: is 3"),
    "held-out names are numbers": (lambda c: c.update(test_filenames=[3]), "test_filenames: is no list of str"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_unusable_value_is_named_with_file_field_and_fix(tmp_path: Path, damage: str) -> None:
    content = transforms_scene(tmp_path)
    change, message = DAMAGE[damage]
    change(content)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(SplatbotError, match=message) as caught:
        open_dataset(tmp_path)
    assert caught.value.file is not None
    assert caught.value.hint


def test_rounded_rotations_become_exact(tmp_path: Path) -> None:
    content = transforms_scene(tmp_path)
    exact = open_dataset(tmp_path)
    for frame in content["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 4).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    for view, true in zip(open_dataset(tmp_path).views, exact.views, strict=True):
        R = view.T_world_camera[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(view.T_world_camera, true.T_world_camera, atol=2e-4)


@pytest.mark.parametrize("text", ["", "{", "[1]", "[" * 100_000, '"\\ud800"', "\x00"])
def test_damaged_json_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(FormatError, match=r"transforms\.json: is no"):
        open_dataset(tmp_path)


def test_cut_off_and_altered_json_gives_errors_of_splatbot_or_a_dataset(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    content = transforms_scene(tmp_path, fl_x=140.0, k1=0.1, k2=-0.05, w=WIDTH, h=HEIGHT, camera_model="OPENCV")
    whole, errors = json.dumps(content).encode(), 0
    for case in range(200):
        data = bytearray(whole)
        if case % 10 == 0:
            del data[rng.integers(len(data)) :]
        else:
            data[rng.integers(len(data))] = rng.choice(list(b'0123456789-.e"[]{},:x\x00\xff'))
        (tmp_path / "transforms.json").write_bytes(data)
        try:
            assert np.isfinite(open_dataset(tmp_path).scene_extent)
        except SplatbotError:
            errors += 1
    assert 20 < errors < 200
