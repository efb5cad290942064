"""Record3D's .r3d recordings."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import liblzfse
import numpy as np
import pytest

from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.record3d import Record3dLog
from tests.unit.logs.published import Pose, encoded, write_record3d

Scene = tuple[list[Frame], list[Pose]]


@pytest.fixture
def file(tmp_path: Path, scene: Scene) -> Path:
    return write_record3d(tmp_path, *scene)


def rewrite(path: Path, **entries: bytes | None) -> Path:
    """Replace entries of the archive, whose names have _ for / and ., or remove them."""
    changed = {name.replace("_", "/", 1).replace("_", ".") if "_" in name else name: v for name, v in entries.items()}
    with zipfile.ZipFile(path) as old:
        kept = {name: old.read(name) for name in old.namelist()} | changed
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name, data in kept.items():
            if data is not None:
                new.writestr(name, data)
    return path


def with_metadata(path: Path, **changes: Any) -> Path:
    with zipfile.ZipFile(path) as old:
        values = json.loads(old.read("metadata")) | changes
    kept = {key: value for key, value in values.items() if value is not None}
    return rewrite(path, metadata=json.dumps(kept).encode())


def test_frames_stamps_and_poses_are_read(file: Path, scene: Scene) -> None:
    frames, poses = scene
    log = open_log(file)
    assert (len(log), log.name, log.camera) == (6, "scan", frames[0].camera)
    for frame, exact in zip(log, frames, strict=True):
        np.testing.assert_array_equal(frame.depth, exact.depth)
        assert np.abs(frame.rgb.astype(int) - exact.rgb).mean() < 3  # JPEG
        assert frame.stamp == frame.index / 30
    truth = log.ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, poses, atol=1e-9)


def test_depth_of_lidar_keeps_its_size_and_colour_is_averaged_over_its_pixels(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (960, 720, 3), dtype=np.uint8)
    depth = np.random.default_rng(1).uniform(0.5, 4, (256, 192)).astype(np.float32)
    metadata = {"w": 720, "h": 960, "fps": 60, "K": [700.0, 0, 0, 0, 700.0, 0, 360.0, 480.0, 1], "poses": []}
    with zipfile.ZipFile(tmp_path / "a.r3d", "w") as out:
        out.writestr("metadata", json.dumps(metadata))
        out.writestr("rgbd/0.jpg", encoded(rgb, ".jpg"))
        out.writestr("rgbd/0.depth", liblzfse.compress(depth.tobytes()))
    log = open_log(tmp_path / "a.r3d")
    frame = log[0]
    assert (frame.camera.width, frame.camera.height) == (192, 256)  # dw, dh are missing: from the size of the depth
    assert frame.camera.fx == pytest.approx(700 * 192 / 720)
    np.testing.assert_array_equal(frame.depth, depth)
    assert frame.rgb.std() < 0.4 * rgb.std()
    assert log.ground_truth is None


def test_pixels_of_low_confidence_have_no_depth(file: Path, scene: Scene) -> None:
    confidence = np.full((120, 160), 1, np.uint8)
    confidence[:, :80] = 0
    rewrite(file, rgbd_1_conf=liblzfse.compress(confidence.tobytes()), rgbd_2_conf=None)
    log = open_log(file)
    np.testing.assert_array_equal(log[1].depth, np.where(confidence == 0, 0, scene[0][1].depth))
    np.testing.assert_array_equal(log[2].depth, scene[0][2].depth)


def test_frames_with_own_intrinsics_are_resampled_to_those_of_the_log(file: Path, scene: Scene) -> None:
    c = scene[0][0].camera
    rows = [[c.fx, c.fy, c.cx, c.cy]] * 5 + [[c.fx, c.fy, c.cx + 4, c.cy - 3]]
    log = open_log(with_metadata(file, perFrameIntrinsicCoeffs=rows))
    np.testing.assert_array_equal(log[4].depth, scene[0][4].depth)
    np.testing.assert_array_equal(log[5].depth[4:, :-5], scene[0][5].depth[1:-3, 4:-1])
    difference = np.abs(log[5].rgb[4:, :-5].astype(int) - scene[0][5].rgb[1:-3, 4:-1])
    assert difference.mean() < 3


def test_timestamps_of_the_frames_are_used_if_they_increase(file: Path) -> None:
    stamps = [0.0, 0.1, 0.25, 0.3, 0.5, 0.75]
    assert [f.stamp for f in open_log(with_metadata(file, frameTimestamps=stamps))] == stamps
    assert open_log(with_metadata(file, frameTimestamps=stamps[::-1]))[3].stamp == 3 / 30
    assert open_log(with_metadata(file, frameTimestamps=["a"] * 6))[3].stamp == 3 / 30


def test_poses_that_are_missing_or_not_finite_are_left_out(file: Path, scene: Scene) -> None:
    rows: list[list[float]] = [[0, 0, 0, 0, 0, 0, 0], [float("nan")] * 7, [0, 0, 0, 1, 1, 2, 3]]
    truth = open_log(with_metadata(file, poses=rows)).ground_truth
    assert truth is not None
    assert truth.stamps.tolist() == [2 / 30]
    np.testing.assert_allclose(truth.T_world_camera[0], [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])


def test_frames_without_a_partner_are_counted(file: Path) -> None:
    log = open_log(rewrite(file, rgbd_1_jpg=None, rgbd_3_depth=None))
    assert isinstance(log, Record3dLog)
    assert log.unpaired == 2
    assert [frame.stamp for frame in log] == [0, 2 / 30, 4 / 30, 5 / 30]


@pytest.mark.parametrize(
    "change",
    [
        {"K": None},
        {"K": [1, 2]},
        {"K": ["a"] * 9},
        {"K": [float("nan")] * 9},
        {"w": None},
        {"w": 2**31, "h": 2**31},
        {"w": float("inf")},
        {"dw": 2**31},
        {"dw": -1},
        {"dw": 30_000, "dh": 30_000},
        {"dw": None},
        {"fps": 0},
        {"fps": "fast"},
        {"poses": [[1, 2]]},
        {"poses": 7},
        {"poses": {"a": 1}},
        {"perFrameIntrinsicCoeffs": "none"},
    ],
)
def test_damaged_metadata_are_refused_on_opening(file: Path, change: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=rf"{file}: .*Fix: "):
        open_log(with_metadata(file, **change))


@pytest.mark.parametrize("data", [b"", b"{", b"[1]", b"[" * 100_000, None])
def test_metadata_that_are_no_object_are_refused(file: Path, data: bytes | None) -> None:
    with pytest.raises(LogError, match=rf"{file}: metadata: .*Fix: "):
        open_log(rewrite(file, metadata=data))


@pytest.mark.parametrize("keep", [0, 10, 0.5, 0.999])
def test_a_file_that_is_cut_off_is_refused(file: Path, keep: float) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(keep * len(data)) if keep < 1 else int(keep)])
    with pytest.raises(LogError, match=rf"{file}: file: .*Fix: "):
        open_log(file)


def test_a_file_without_frames_is_refused(tmp_path: Path, scene: Scene) -> None:
    path = rewrite(write_record3d(tmp_path, scene[0][:1], scene[1][:1]), rgbd_0_jpg=None)
    with pytest.raises(LogError, match=r"rgbd: the log is empty"):
        open_log(path)


@pytest.mark.parametrize(
    ("entry", "data", "field"),
    [
        ("rgbd_2_depth", lambda: b"", "depth"),
        ("rgbd_2_depth", lambda: liblzfse.compress(bytes(50_000_000)), "depth"),
        ("rgbd_2_depth", lambda: liblzfse.compress(bytes(4 * 160 * 119)), "depth"),
        ("rgbd_2_depth", lambda: bytes(50_000_000), "rgbd/2.depth"),  # a bomb of the ZIP file
        ("rgbd_2_depth", lambda: liblzfse.compress(bytes(4 * 160 * 120)), "depth"),  # no valid pixel
        ("rgbd_2_depth", lambda: liblzfse.compress(np.full(160 * 120, -1, np.float32).tobytes()), "depth"),
        ("rgbd_2_conf", lambda: liblzfse.compress(bytes(5)), "conf"),
        ("rgbd_2_conf", lambda: b"bvx-\xff\xff\xff\xff", "conf"),
        ("rgbd_2_jpg", lambda: b"", "colour"),
        ("rgbd_2_jpg", lambda: encoded(np.zeros((60, 80, 3), np.uint8), ".jpg"), "colour"),
        ("rgbd_2_jpg", lambda: encoded(np.zeros((120, 160, 3), np.uint8), ".jpg")[:-2], "colour"),
    ],
)
def test_one_damaged_image_spoils_its_frame_alone(
    file: Path, entry: str, data: Callable[[], bytes], field: str
) -> None:
    log = open_log(rewrite(file, **{entry: data()}))
    with pytest.raises(LogError, match=rf"scan\.r3d \(rgbd/2\.\w+\): {field}: .*Fix: "):
        log.read(2)
    assert log.read(3).index == 3
