"""COLMAP scenes, compared with pycolmap."""

from __future__ import annotations

import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from splatbot.errors import FormatError, LogError, SplatbotError
from splatbot.training.datasets import TrainingData, open_dataset
from tests.unit.training.datasets.scenes import (
    CAMERA_PARAMS,
    HEIGHT,
    RAYS,
    UNSUPPORTED_PARAMS,
    WIDTH,
    colmap_scene,
    mark_centers,
)

PINHOLES = {name: CAMERA_PARAMS[name] for name in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL")}


@pytest.fixture(scope="module")
def can(data_root: Path) -> tuple[TrainingData, pycolmap.Reconstruction]:
    """The real scene of a can on a floor, and pycolmap's reading of it."""
    folder = data_root / "colmap_can"
    return open_dataset(folder), pycolmap.Reconstruction(folder / "sparse" / "0")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A binary scene of three images."""
    colmap_scene(tmp_path / "scene", PINHOLES)
    return tmp_path / "scene"


def same(a: TrainingData, b: TrainingData) -> None:
    """Check that two datasets have the same views and points."""
    assert [view.name for view in a.views] == [view.name for view in b.views]
    assert [view.camera for view in a.views] == [view.camera for view in b.views]
    for one, other in zip(a.views, b.views, strict=True):
        np.testing.assert_allclose(one.T_world_camera, other.T_world_camera, atol=1e-12)
    np.testing.assert_allclose(sorted_points(a), sorted_points(b), atol=1e-12)


def sorted_points(data: TrainingData) -> NDArray[np.float64]:
    """Return positions and colours (M, 6) in an order that rounding does not change."""
    rows = np.hstack([data.points, data.point_colors])
    return rows[np.lexsort(np.round(rows, 9).T)]


def test_poses_intrinsics_and_points_of_a_real_scene_are_those_of_pycolmap(
    can: tuple[TrainingData, pycolmap.Reconstruction],
) -> None:
    data, oracle = can
    images = {image.name: image for image in oracle.images.values()}
    assert data.kind == "colmap"
    assert [view.name for view in data.views] == sorted(images)
    for view in data.views:
        image = images[view.name]
        camera = oracle.cameras[image.camera_id]
        expected = np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(view.T_world_camera, expected, atol=1e-12)
        np.testing.assert_allclose(view.camera.K_corner, camera.calibration_matrix())
        assert view.camera_name == f"camera {image.camera_id}"
        assert (view.camera.width, view.camera.height) == (camera.width, camera.height)
    points = sorted((*point.xyz, *point.color) for point in oracle.points3D.values())
    ours = sorted((*xyz, *rgb) for xyz, rgb in zip(data.points, data.point_colors, strict=True))
    np.testing.assert_array_equal(ours, points)


def test_points_of_a_real_scene_project_to_their_undistorted_observations(
    can: tuple[TrainingData, pycolmap.Reconstruction],
) -> None:
    data, oracle = can
    views, errors = {view.name: view for view in data.views}, []
    for image in oracle.images.values():
        view, camera = views[image.name], oracle.cameras[image.camera_id]
        seen = image.get_observation_points2D()
        world = np.array([oracle.points3D[p.point3D_id].xyz for p in seen])
        rays = camera.cam_from_img(np.array([p.xy for p in seen]))
        observed = view.camera.project(np.column_stack([rays, np.ones(len(rays))]))
        T = np.linalg.inv(view.T_world_camera)
        errors.append(np.linalg.norm(view.camera.project(world @ T[:3, :3].T + T[:3, 3]) - observed, axis=1))
    assert np.median(np.concatenate(errors)) < 1.0


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("scale", [1, 2])
def test_marks_of_each_camera_model_lie_at_their_pinhole_projections(tmp_path: Path, scale: int, text: bool) -> None:
    colmap_scene(tmp_path, CAMERA_PARAMS, text=text)
    data = open_dataset(tmp_path, scale=scale)
    assert len(data.views) == len(CAMERA_PARAMS)
    for view in data.views:
        pixels, image = view.camera.project(RAYS), view.read()
        assert image.shape == (HEIGHT // scale, WIDTH // scale, 3)
        np.testing.assert_allclose(mark_centers(image, pixels, 8 // scale), pixels, atol=0.2, err_msg=view.name)


def test_text_and_binary_models_give_the_same_dataset(
    tmp_path: Path, data_root: Path, can: tuple[TrainingData, pycolmap.Reconstruction]
) -> None:
    data, oracle = can
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "images").symlink_to(data_root / "colmap_can" / "images")
    oracle.write_text(tmp_path / "sparse" / "0")
    same(open_dataset(tmp_path), data)


@pytest.mark.parametrize("place", [".", "sparse", "sparse/0"])
def test_scene_opens_by_each_of_its_folders(scene: Path, place: str) -> None:
    same(open_dataset(scene / place), open_dataset(scene))


def test_model_directly_in_sparse_or_in_the_folder_opens(scene: Path) -> None:
    expected = open_dataset(scene)
    for name in ("cameras", "images", "points3D"):
        (scene / "sparse" / "0" / f"{name}.bin").rename(scene / "sparse" / f"{name}.bin")
    same(open_dataset(scene), expected)
    for name in ("cameras", "images", "points3D"):
        (scene / "sparse" / f"{name}.bin").rename(scene / f"{name}.bin")
    same(open_dataset(scene), expected)


def test_smaller_images_are_used_if_their_size_fits(scene: Path) -> None:
    shutil.copytree(scene / "images", scene / "images_2")
    for name, shape in (("PINHOLE", (HEIGHT // 2, WIDTH // 2)), ("SIMPLE_PINHOLE", (HEIGHT // 2, WIDTH // 4))):
        cv2.imwrite(str(scene / "images_2" / f"{name}.png"), np.full((*shape, 3), 77, np.uint8))
    views = {view.name: view for view in open_dataset(scene, scale=2).views}
    assert {view.read().shape for view in views.values()} == {(HEIGHT // 2, WIDTH // 2, 3)}
    assert (views["PINHOLE.png"].read() == 77).all()
    assert not (views["SIMPLE_PINHOLE.png"].read() == 77).all()


def test_only_views_of_distorted_cameras_have_a_mask(scene: Path) -> None:
    masked = {view.name: view.read_mask for view in open_dataset(scene).views}
    assert masked["PINHOLE.png"] is None
    mask = masked["SIMPLE_RADIAL.png"]
    assert mask is not None
    assert 0.0 < mask().mean() < 0.2


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", UNSUPPORTED_PARAMS)
def test_unsupported_camera_model_is_named_with_the_command_that_undistorts(
    tmp_path: Path, model: str, text: bool
) -> None:
    colmap_scene(tmp_path, {model: UNSUPPORTED_PARAMS[model]}, text=text)
    with pytest.raises(FormatError, match=rf"cameras.*{model};.*colmap image_undistorter"):
        open_dataset(tmp_path)


def test_missing_images_are_counted_and_the_first_is_named(scene: Path) -> None:
    (scene / "images" / "PINHOLE.png").unlink()
    (scene / "images" / "SIMPLE_PINHOLE.png").unlink()
    with pytest.raises(LogError, match=r"PINHOLE\.png: image: is missing, the first of 2 of 3"):
        open_dataset(scene)
    shutil.rmtree(scene / "images")
    with pytest.raises(LogError, match="has no folder images"):
        open_dataset(scene)


def test_image_of_another_size_than_its_camera_is_named(scene: Path) -> None:
    cv2.imwrite(str(scene / "images" / "PINHOLE.png"), np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    with pytest.raises(LogError, match=r"PINHOLE\.png: size: is 161x120, its camera is 160x120"):
        open_dataset(scene)


def test_incomplete_model_names_the_files_that_belong_to_it(scene: Path) -> None:
    (scene / "sparse" / "0" / "points3D.bin").unlink()
    with pytest.raises(FormatError, match="cameras, images and points3D"):
        open_dataset(scene)


TEXT_DAMAGE: dict[str, tuple[str, Callable[[str], str], str]] = {
    "width is no number": ("cameras", lambda t: t.replace(" 160 ", " wide ", 1), r"line \d+: is damaged"),
    "a parameter is left out": ("cameras", lambda t: t.rstrip().rsplit(" ", 1)[0], r"line \d+: is damaged"),
    "focal length is NaN": ("cameras", lambda t: t.replace(" 140 ", " nan ", 1), r"camera \d fx: is nan"),
    "focal length is zero": ("cameras", lambda t: t.replace(" 140 ", " 0 ", 1), "fx: is 0.*positive"),
    "image is huge": ("cameras", lambda t: t.replace(" 160 ", " 99999999 ", 1), "64 megapixels"),
    "camera is there twice": ("cameras", lambda t: t + "1 PINHOLE 160 120 140 140 80 60\n", "camera 1: is there twice"),
    "camera is unknown": ("cameras", lambda t: "\n".join(t.split("\n")[:-2]) + "\n", "CAMERA_ID: is 3"),
    "model is unknown": ("cameras", lambda t: t.replace(" PINHOLE", " BOX"), "BOX; supported are SIMPLE_PINHOLE"),
    "image has no name": ("images", lambda t: t.replace(" PINHOLE.png", ""), r"line \d+: is damaged"),
    "image is outside of the folder": ("images", lambda t: t.replace(" PINHOLE", " ../PINHOLE"), r"PINHOLE\.png NAME"),
    "no image": ("images", lambda t: "# empty\n", "has no images"),
    "image is there twice": ("images", lambda t: t.replace(" PINHOLE.png", " SIMPLE_PINHOLE.png"), "twice"),
    "point is NaN": ("points3D", lambda t: t.replace(" 0.5 ", " nan ", 1), "1 of 3 points hold NaN"),
    "colour is not of 8 bits": ("points3D", lambda t: t.replace(" 10 20 ", " 10 256 ", 1), r"line \d+: is damaged"),
    "point is cut off": ("points3D", lambda t: t.rstrip()[:-12], r"line \d+: is damaged"),
}


@pytest.mark.parametrize("damage", TEXT_DAMAGE)
def test_damage_of_a_text_model_is_named_with_file_field_and_fix(tmp_path: Path, damage: str) -> None:
    colmap_scene(tmp_path, PINHOLES, text=True)
    name, change, message = TEXT_DAMAGE[damage]
    file = tmp_path / "sparse" / "0" / f"{name}.txt"
    changed = change(file.read_text())
    assert changed != file.read_text()
    file.write_text(changed)
    with pytest.raises(SplatbotError, match=message) as caught:
        open_dataset(tmp_path)
    assert caught.value.file is not None
    assert caught.value.field
    assert caught.value.hint


@pytest.mark.parametrize(
    ("column", "value", "field"), [(1, "0 0 0 0", "QW"), (5, "nan 0 0", "TX"), (5, "1e300 0 0", "TX")]
)
def test_unusable_pose_names_its_image(tmp_path: Path, column: int, value: str, field: str) -> None:
    colmap_scene(tmp_path, PINHOLES, text=True)
    file = tmp_path / "sparse" / "0" / "images.txt"
    lines = file.read_text().split("\n")
    row = next(i for i, line in enumerate(lines) if line.endswith(" PINHOLE.png"))
    words = lines[row].split()
    words[column : column + len(value.split())] = value.split()
    lines[row] = " ".join(words)
    file.write_text("\n".join(lines))
    with pytest.raises(FormatError, match=rf"image PINHOLE\.png {field}"):
        open_dataset(tmp_path)


def test_counts_beyond_the_end_of_the_file_allocate_nothing(scene: Path) -> None:
    for name in ("cameras", "images", "points3D"):
        file = scene / "sparse" / "0" / f"{name}.bin"
        whole = file.read_bytes()
        file.write_bytes((2**61).to_bytes(8, "little") + whole[8:])
        tracemalloc.start()
        with pytest.raises(FormatError, match=rf"{name}\.bin: count of \w+: is {2**61}, but only"):
            open_dataset(scene)
        assert tracemalloc.get_traced_memory()[1] < 2**20
        tracemalloc.stop()
        file.write_bytes(whole)


@pytest.mark.parametrize("text", [False, True])
def test_cut_off_and_altered_models_give_errors_of_splatbot_or_a_dataset(
    tmp_path: Path, text: bool, rng: np.random.Generator
) -> None:
    colmap_scene(tmp_path, PINHOLES, text=text)
    model, suffix = tmp_path / "sparse" / "0", ".txt" if text else ".bin"
    files = [model / f"{name}{suffix}" for name in ("cameras", "images", "points3D")]
    whole = {file: file.read_bytes() for file in files}
    errors: list[SplatbotError] = []
    tracemalloc.start()
    for case in range(150):
        file = files[case % len(files)]
        data = bytearray(whole[file])
        if case % 2:
            del data[rng.integers(len(data)) :]
        else:
            data[rng.integers(len(data))] = rng.integers(256)
        file.write_bytes(data)
        try:
            assert np.isfinite(open_dataset(tmp_path).scene_extent)
        except SplatbotError as error:
            errors.append(error)
        file.write_bytes(whole[file])
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()
    assert 20 < len(errors) < 150
    assert all(error.file and error.hint for error in errors)
