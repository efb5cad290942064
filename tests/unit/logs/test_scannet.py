"""ScanNet's .sens recordings."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.geometry import se3_exp, transform_points
from splatbot.logs import open_log
from splatbot.logs.scannet import ScanNetLog
from tests.unit.logs.published import Pose, encoded, sens_frame, sens_header, write_sens

Scene = tuple[list[Frame], list[Pose]]
NAME_END = 12 + len("StructureSensor")
COUNT_AT = NAME_END + 4 * 64 + 28
HEADER = COUNT_AT + 8


@pytest.fixture
def file(tmp_path: Path, scene: Scene) -> Path:
    return write_sens(tmp_path, *scene)


def small(tmp_path: Path, **options: Any) -> Path:
    """Write one frame whose colour camera differs from the depth camera."""
    path = tmp_path / "small.sens"
    v, u = np.mgrid[:96, :132]
    image = np.stack([u, 2 * v, u], -1).astype(np.uint8)
    header = sens_header(matrix(COLOR), matrix(DEPTH), (132, 96), (64, 48), 1, kinds=(1, 0), **options)
    depth = np.full((48, 64), 1250, np.uint16)
    path.write_bytes(header + sens_frame(encoded(image), depth.tobytes(), np.eye(4), 0))
    return path


COLOR, DEPTH = Camera(130.0, 131.0, 66.0, 47.0, 132, 96), Camera(60.0, 61.0, 31.5, 23.5, 64, 48)


def matrix(camera: Camera) -> np.ndarray:
    K = np.eye(4)
    K[:3, :3] = camera.K
    return K


@pytest.mark.parametrize("raw", [False, True])
def test_frames_stamps_and_poses_are_read(tmp_path: Path, scene: Scene, raw: bool) -> None:
    frames, poses = scene
    log = open_log(write_sens(tmp_path, frames, poses, raw=raw))
    assert (len(log), log.name) == (6, "scan")
    np.testing.assert_allclose(log.camera.K, frames[0].camera.K, rtol=1e-6)  # float32
    for frame, exact in zip(log, frames, strict=True):
        np.testing.assert_array_equal(frame.depth, exact.depth)
        assert frame.stamp == pytest.approx(exact.stamp + 1, abs=1e-6)
        assert np.abs(frame.rgb.astype(int) - exact.rgb).mean() <= (0 if raw else 3)
    truth = log.ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, poses, atol=1e-6)


def test_colour_is_resampled_at_the_depth_pixels(tmp_path: Path) -> None:
    T = se3_exp([0.04, 0.0, 0.01, 0.0, 0.02, 0.0])
    frame = open_log(small(tmp_path, T_color=T))[0]
    uv = COLOR.project(transform_points(T, DEPTH.backproject(np.full((48, 64), 1.25, np.float32))))
    inside = ((uv > 3) & (uv < [128, 92])).all(-1)
    assert inside.mean() > 0.7
    np.testing.assert_allclose(frame.rgb[inside][:, :2], uv[inside] * [1, 2], atol=1.6)


def test_opening_reads_no_image(file: Path, scene: Scene) -> None:
    data = bytearray(file.read_bytes())
    reference = open_log(file)
    at = HEADER + 96  # the first image
    data[at : at + 500] = bytes(500)
    file.write_bytes(data)
    log = open_log(file)
    assert len(log) == len(reference)
    with pytest.raises(LogError, match=r"scan\.sens \(frame 0\): colour: .*Fix: "):
        log.read(0)
    assert log.read(1).index == 1


@pytest.mark.parametrize("cut", [1, 100, 3000])
def test_a_recording_that_is_cut_off_keeps_the_whole_frames(
    file: Path, cut: int, caplog: pytest.LogCaptureFixture
) -> None:
    file.write_bytes(file.read_bytes()[:-cut])
    log = open_log(file)
    assert isinstance(log, ScanNetLog)
    assert (len(log), log.lost) == (5, 1)
    assert len(list(log)) == 5
    assert "last 1 of 6 frames are missing" in caplog.text


@pytest.mark.parametrize("keep", [0, 3, 11, 20, NAME_END + 100, COUNT_AT, HEADER - 1, HEADER, HEADER + 95, HEADER + 96])
def test_a_file_without_a_whole_frame_is_refused(file: Path, keep: int) -> None:
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(LogError, match=rf"{file}: (header|frames): .*Fix: "):
        open_log(file)


@pytest.mark.parametrize(
    ("at", "value", "field"),
    [
        (0, struct.pack("<I", 5), "version"),
        (4, struct.pack("<Q", 2**63), "sensor name"),
        (NAME_END, struct.pack("<f", float("nan")), "fx"),
        (NAME_END + 64, struct.pack("<f", 7.0), "extrinsic"),
        (NAME_END + 256, struct.pack("<i", 3), "compression"),
        (NAME_END + 260, struct.pack("<i", 2), "compression"),  # OCCI
        (NAME_END + 264, struct.pack("<II", 2**32 - 1, 2**32 - 1), "image size"),
        (NAME_END + 272, struct.pack("<II", 2**31, 1), "image size"),
        (NAME_END + 272, struct.pack("<I", 0), "width"),
        (NAME_END + 280, struct.pack("<f", 0.0), "depth_scale"),
        (COUNT_AT, struct.pack("<Q", 0), "frames"),
    ],
)
def test_a_damaged_header_is_refused_on_opening(file: Path, at: int, value: bytes, field: str) -> None:
    data = bytearray(file.read_bytes())
    data[at : at + len(value)] = value
    file.write_bytes(data)
    with pytest.raises(InputError, match=rf"scan\.sens: {field}: .*Fix: "):
        open_log(file)


def test_huge_counts_and_sizes_allocate_nothing(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[COUNT_AT:HEADER] = struct.pack("<Q", 2**64 - 1)
    file.write_bytes(data)
    tracemalloc.start()
    log = open_log(file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(log) == 6
    assert peak < 20e6
    data[HEADER + 80 : HEADER + 88] = struct.pack("<Q", 2**64 - 1)  # bytes of the first colour image
    file.write_bytes(data)
    with pytest.raises(LogError, match="empty"):
        open_log(file)


def test_poses_that_are_not_finite_or_not_rigid_are_left_out(tmp_path: Path, scene: Scene) -> None:
    frames, poses = scene
    lost = [np.full((4, 4), -np.inf), np.full((4, 4), np.nan), 2 * np.eye(4), *poses[3:]]
    log = open_log(write_sens(tmp_path, frames, lost))
    truth = log.ground_truth
    assert truth is not None
    assert len(truth) == 3
    assert len(list(log)) == 6


@pytest.mark.parametrize("stamps", [[0, 0, 0], [5, 4, 3], [0, 1, 1]])
def test_stamps_that_do_not_increase_become_thirty_a_second(tmp_path: Path, stamps: list[int]) -> None:
    depth, color = np.full((48, 64), 900, np.uint16).tobytes(), encoded(np.full((96, 132, 3), 9, np.uint8))
    data = sens_header(matrix(COLOR), matrix(DEPTH), (132, 96), (64, 48), 3, kinds=(1, 0))
    for stamp in stamps:
        data += sens_frame(color, depth, np.eye(4), stamp)
    (tmp_path / "a.sens").write_bytes(data)
    assert [frame.stamp for frame in open_log(tmp_path / "a.sens")] == [0, 1 / 30, 2 / 30]


@pytest.mark.parametrize(
    "depth",
    [
        zlib.compress(bytes(2**26)),  # a bomb of 64 MB
        zlib.compress(bytes(10)),
        b"no zlib",
        b"",
    ],
)
def test_damaged_or_oversized_depth_spoils_its_frame_alone(tmp_path: Path, depth: bytes) -> None:
    good = zlib.compress(np.full((48, 64), 900, np.uint16).tobytes())
    color = encoded(np.full((96, 132, 3), 9, np.uint8))
    data = sens_header(matrix(COLOR), matrix(DEPTH), (132, 96), (64, 48), 2, kinds=(1, 1))
    data += sens_frame(color, depth, np.eye(4), 1) + sens_frame(color, good, np.eye(4), 2)
    (tmp_path / "a.sens").write_bytes(data)
    log = open_log(tmp_path / "a.sens")
    tracemalloc.start()
    with pytest.raises(LogError, match=r"a\.sens \(frame 0\): depth: .*Fix: "):
        log.read(0)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()
    assert log.read(1).index == 1


def test_a_colour_image_of_another_size_is_not_decoded(tmp_path: Path) -> None:
    color = bytearray(encoded(np.full((96, 132, 3), 9, np.uint8)))
    color[16:24] = struct.pack(">II", 30_000, 30_000)
    data = sens_header(matrix(COLOR), matrix(DEPTH), (132, 96), (64, 48), 1, kinds=(1, 0))
    data += sens_frame(bytes(color), np.full((48, 64), 900, np.uint16).tobytes(), np.eye(4), 0)
    (tmp_path / "a.sens").write_bytes(data)
    with pytest.raises(LogError, match="colour: is no image of 132x96"):
        open_log(tmp_path / "a.sens").read(0)


def test_a_camera_of_the_user_is_refused(file: Path) -> None:
    with pytest.raises(LogError, match="its own camera"):
        open_log(file, camera="tum_fr1")
