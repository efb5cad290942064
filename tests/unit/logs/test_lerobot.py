"""LeRobot datasets of version 3 with depth."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import CameraError, LogError
from splatbot.frame import Frame
from splatbot.geometry import rotation_to_quat
from splatbot.logs import open_log
from tests.unit.logs.published import Pose

pytest.importorskip("av", reason="av (extra lerobot) is not installed")
pytest.importorskip("pyarrow", reason="pyarrow (extra lerobot) is not installed")

from tests.unit.logs.lerobot_dataset import (
    DATA,
    FPS,
    WRIST,
    edit_feature,
    edit_info,
    edit_table,
    video_path,
    write_lerobot,
    write_video,
)

Scene = tuple[list[Frame], list[Pose]]
STATE = {"dtype": "float32", "shape": [2], "names": ["shoulder.pos", "elbow.pos"]}


def steps(depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return half of the difference between neighbouring codes of LeRobot's quantization at a depth [m]."""
    return 0.5 * (depth.astype(np.float64) + 3.5) * np.log(13.5 / 3.51) / 4095


def numbered(shape: tuple[int, ...], number: int) -> NDArray[np.uint8]:
    """Return an image whose quarters have the four digits of a number to the base 4 as shades."""
    digits = np.array([[number % 4, number // 4 % 4], [number // 16 % 4, number // 64]])
    shades = np.kron(40 + 50 * digits, np.ones((shape[0] // 2, shape[1] // 2)))
    return np.repeat(shades[..., None], 3, -1).astype(np.uint8)


def number_of(image: NDArray[np.uint8]) -> int:
    """Return the number that an image shows."""
    h, w = image.shape[0] // 4, image.shape[1] // 4
    a, b, c, d = np.rint((image[[h, h, 3 * h, 3 * h], [w, 3 * w, w, 3 * w], 1].astype(float) - 40) / 50).astype(int)
    return int(a + 4 * b + 16 * c + 64 * d)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_images_are_read_without_rounding(tmp_path: Path, scene: Scene, unit: str) -> None:
    frames, _ = scene
    log = open_log(write_lerobot(tmp_path / "desk", {WRIST: [frames]}, unit=unit))
    assert (len(log), log.name, log.camera, log.ground_truth) == (6, "desk_000", frames[0].camera, None)
    for frame, exact in zip(log, frames, strict=True):
        np.testing.assert_array_equal(frame.rgb, exact.rgb)
        np.testing.assert_array_equal(frame.depth, exact.depth)
        assert frame.stamp == pytest.approx(exact.index / FPS, abs=1e-7)


def test_units_that_the_dataset_does_not_name_are_millimetres_of_integers(tmp_path: Path, scene: Scene) -> None:
    for unit in ("mm", "m"):
        folder = write_lerobot(tmp_path / unit, {WRIST: [scene[0]]}, unit=unit)
        edit_feature(folder, f"{WRIST}_depth", info={"is_depth_map": True})
        np.testing.assert_array_equal(open_log(folder)[2].depth, scene[0][2].depth)


def test_videos_are_read_within_their_quantization(tmp_path: Path, scene: Scene) -> None:
    frames = scene[0]
    holed = [Frame(f.stamp, f.rgb, f.depth * (np.arange(160) > 40), f.camera, f.index) for f in frames]
    holed[1].depth[50, 100] = 12.0  # beyond the range
    log = open_log(write_lerobot(tmp_path, {WRIST: [holed]}, video=True))
    for frame, exact in zip(log, holed, strict=True):
        inside = (exact.depth > 0) & (exact.depth < 10)
        np.testing.assert_array_equal(frame.depth > 0, inside)
        assert (np.abs(frame.depth - exact.depth) <= steps(exact.depth) + 1e-6)[inside].all()
        assert np.abs(frame.rgb.astype(int) - exact.rgb).mean() < 6


def test_linear_codes_are_read(tmp_path: Path, scene: Scene) -> None:
    frame = scene[0][0]
    folder = write_lerobot(tmp_path, {WRIST: [[frame] * 3]}, video=True)
    info = {"is_depth_map": True, "video.depth_min": 0.0, "video.depth_max": 4.095, "video.use_log": False}
    edit_feature(folder, f"{WRIST}_depth", info=info)
    codes = [np.rint(1000 * frame.depth).astype(np.uint16)] * 3
    hevc = {"x265-params": "lossless=1:log-level=none"}
    write_video(folder / video_path(f"{WRIST}_depth"), codes, "gray12le", "libx265", **hevc)
    np.testing.assert_allclose(open_log(folder)[1].depth, frame.depth, atol=1e-6)


@pytest.mark.parametrize(
    ("codec", "options"),
    [
        ("libx264", {"g": "50", "bf": "3", "crf": "4"}),  # frames that are stored out of order
        ("libx265", {"g": "25", "x265-params": "open-gop=1:bframes=4:crf=4:log-level=none"}),
        ("libsvtav1", {"g": "60", "crf": "10"}),
        ("libsvtav1", {"g": "2", "crf": "10"}),
    ],
)
def test_frame_k_of_a_long_video_is_frame_k_in_any_order(
    tmp_path: Path, scene: Scene, codec: str, options: dict[str, str]
) -> None:
    frame = scene[0][0]
    numbers = [numbered(frame.rgb.shape, k) for k in range(120)]
    episodes = [[Frame(0.0, numbers[k], frame.depth, frame.camera, k) for k in part] for part in (range(70), range(50))]
    folder = write_lerobot(tmp_path, {WRIST: episodes}, video=True)
    write_video(folder / video_path(WRIST), numbers, "rgb24", codec, **options)
    order = [*range(70), 69, 0, 35, 34, 33, 3, 68, 2, 1, 50, 49, *np.random.default_rng(0).integers(0, 70, 30).tolist()]
    for episode, first, length in ((0, 0, 70), (1, 70, 50)):
        log = open_log(f"{folder}?episode={episode}")
        assert len(log) == length
        for k in order:
            if k < length:
                assert number_of(log[k].rgb) == first + k


def test_frame_k_of_images_is_frame_k_in_any_order(tmp_path: Path, scene: Scene) -> None:
    frames = [Frame(0.0, np.full_like(f.rgb, 3 * k), f.depth, f.camera, k) for k in range(60) for f in scene[0][:1]]
    folder = write_lerobot(tmp_path, {WRIST: [frames[:45], frames[45:]]}, group=23)
    for episode, first, length in ((0, 0, 45), (1, 45, 15)):
        log = open_log(f"{folder}?episode={episode}")
        for k in [*range(length), 0, length - 1, 7, 6, *np.random.default_rng(0).integers(0, length, 40).tolist()]:
            assert (log[k].rgb == 3 * (first + k)).all(), k


def test_a_camera_is_chosen_by_its_name_or_by_its_depth(tmp_path: Path, scene: Scene) -> None:
    frames = scene[0]
    folder = write_lerobot(tmp_path, {WRIST: [frames], "observation.images.top": [frames[::-1]]})
    with pytest.raises(LogError, match=r"observation\.images\.top.*wrist_depth.*\?color=KEY&depth=KEY"):
        open_log(folder)
    for choice in ("color=observation.images.top", "depth=observation.images.top_depth"):
        log = open_log(f"{folder}?{choice}")
        np.testing.assert_array_equal(log[0].rgb, frames[5].rgb)
        assert open_log(log.uri)[0].stamp == 0
    mixed = open_log(f"{folder}?color={WRIST}&depth=observation.images.top_depth&episode=0")
    np.testing.assert_array_equal(mixed[0].rgb, frames[0].rgb)
    np.testing.assert_array_equal(mixed[0].depth, frames[5].depth)
    with pytest.raises(LogError, match="choose a camera"):
        open_log(f"{folder}?color=nobody")


def test_joints_have_their_names_and_their_delay(tmp_path: Path, scene: Scene) -> None:
    values = [[0.1 * k, -0.2 * k] for k in range(6)]
    folder = write_lerobot(tmp_path, {WRIST: [scene[0]]}, columns={"observation.state": (STATE, values)})
    frame, delayed = open_log(folder)[3], open_log(folder, joint_delay=0.5 / FPS)[3]
    assert frame.joint_names == ("shoulder", "elbow")
    assert frame.joints == pytest.approx([0.3, -0.6], abs=1e-7)
    assert delayed.joints == pytest.approx([0.35, -0.7], abs=1e-6)
    edit_feature(folder, "observation.state", names={"motors": ["a", "b"]})
    assert open_log(folder)[0].joint_names == ("a", "b")
    for names in (None, ["one"], ["same", "same"], {"a": 1, "b": 2}):
        edit_feature(folder, "observation.state", names=names)
        frame = open_log(folder)[3]
        assert frame.joint_names == ()
        assert frame.joints is not None


def test_stamps_and_poses_of_splatbot_are_read(tmp_path: Path, scene: Scene) -> None:
    frames, poses = scene
    stamps = [1e9 + 0.1 * k + 0.01 * (k % 2) for k in range(6)]
    rows = [[*T[:3, 3], *rotation_to_quat(T[:3, :3])] for T in poses]
    rows[2] = [np.nan] * 7
    columns: dict[str, tuple[dict[str, Any], Sequence[Any]]] = {
        "splatbot.stamp": ({"dtype": "float64", "shape": [1]}, stamps),
        "splatbot.camera_pose": ({"dtype": "float64", "shape": [7]}, rows),
    }
    log = open_log(write_lerobot(tmp_path, {WRIST: [frames]}, columns=columns))
    assert [frame.stamp for frame in log] == stamps
    truth = log.ground_truth
    assert truth is not None
    assert truth.stamps.tolist() == stamps[:2] + stamps[3:]
    np.testing.assert_allclose(truth.T_world_camera, poses[:2] + poses[3:], atol=1e-12)


def test_a_dataset_without_intrinsics_takes_those_of_the_user(tmp_path: Path, scene: Scene) -> None:
    folder = write_lerobot(tmp_path, {WRIST: [scene[0]]})
    (folder / "intrinsics.json").rename(tmp_path / "camera.json")
    with pytest.raises(CameraError, match=r"the dataset has no intrinsics\. Fix: .*--camera FILE"):
        open_log(folder)
    assert open_log(folder, camera=tmp_path / "camera.json").camera == scene[0][0].camera


def test_depth_of_another_camera_takes_its_colour_from_where_it_is_seen(tmp_path: Path, scene: Scene) -> None:
    frame = scene[0][0]
    wall = replace(frame, depth=np.full_like(frame.depth, 2.0))
    folder = write_lerobot(tmp_path, {WRIST: [[wall] * 2]})
    c = frame.camera
    values = json.loads((folder / "intrinsics.json").read_text())
    T = np.eye(4)
    T[0, 3] = 5 * 2.0 / c.fx  # 5 px at 2 m
    (folder / "depth_intrinsics.json").write_text(json.dumps(values | {"T_color_depth": T.tolist()}))
    read = open_log(folder)[1]
    np.testing.assert_array_equal(read.rgb[:, :150], frame.rgb[:, 5:155])
    assert (read.depth[:, :154] == 2).all()
    assert (read.depth[:, 155:] == 0).all()  # outside of the colour image
    assert open_log(folder, camera=folder / "intrinsics.json")[1].depth.all()
    for bad in (None, [1, 2], (2 * T).tolist(), "x", [[10**400] * 4] * 4):
        (folder / "depth_intrinsics.json").write_text(json.dumps(values | {"T_color_depth": bad}))
        with pytest.raises(CameraError, match=r"depth_intrinsics\.json: T_color_depth: is no rigid transform\. Fix: "):
            open_log(folder)
    distorted = values | {"T_color_depth": T.tolist(), "distortion": [0.1, 0, 0, 0]}
    (folder / "depth_intrinsics.json").write_text(json.dumps(distorted))
    with pytest.raises(CameraError, match="distortion: cannot be registered"):
        open_log(folder)


def test_a_dataset_without_depth_is_named(tmp_path: Path, scene: Scene) -> None:
    folder = write_lerobot(tmp_path, {WRIST: [scene[0]]})
    edit_feature(folder, f"{WRIST}_depth", info={})
    with pytest.raises(LogError, match=r"features: has no depth\. Fix: record with a depth camera"):
        open_log(folder)


def test_an_earlier_version_is_named_with_the_way_to_convert_it(tmp_path: Path, scene: Scene) -> None:
    folder = write_lerobot(tmp_path, {WRIST: [scene[0]]})
    edit_info(folder, codebase_version="v2.1")
    with pytest.raises(LogError, match=r"is 'v2\.1', supported is v3\. Fix: convert it"):
        open_log(folder)


@pytest.mark.parametrize("package", ["pyarrow", "av"])
def test_a_missing_package_is_named(
    tmp_path: Path, scene: Scene, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_lerobot(tmp_path, {WRIST: [scene[0]]})
    monkeypatch.setattr("splatbot.logs.lerobot_packages.find_spec", lambda name: None if name == package else sys)
    with pytest.raises(LogError, match=rf"needs the package {package}\. Fix: pip install 'splatbot\[lerobot\]'"):
        open_log(folder)


def test_the_counts_of_the_description_are_not_needed(tmp_path: Path, scene: Scene) -> None:
    folder = write_lerobot(tmp_path, {WRIST: [scene[0]]})
    edit_info(folder, total_frames=2**62, total_episodes=-1)
    assert len(open_log(folder)) == 6


def test_rows_of_other_episodes_may_lie_between(tmp_path: Path, scene: Scene) -> None:
    frames = scene[0]
    folder = write_lerobot(tmp_path, {WRIST: [frames[:3], frames[3:]]})
    order = [3, 0, 4, 1, 5, 2]
    edit_table(
        folder / DATA,
        **{
            name: lambda values: [values[k] for k in order]
            for name in (WRIST, f"{WRIST}_depth", "timestamp", "frame_index", "episode_index", "index")
        },
    )
    log = open_log(f"{folder}?episode=1")
    for k in (2, 0, 1):
        np.testing.assert_array_equal(log[k].rgb, frames[3 + k].rgb)
