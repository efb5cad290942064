"""TUM layout: reading of valid logs."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.logs import open_log
from splatbot.logs.index import associate
from splatbot.logs.mcap import record_mcap
from splatbot.logs.presets import PRESETS
from splatbot.logs.tum import TumLog

MakeLog = Callable[..., Path]


def png(path: Path) -> np.ndarray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def test_colour_is_rgb_and_depth_is_in_metres(make_log: MakeLog) -> None:
    folder = make_log(3)
    log = open_log(folder)
    frame = log[2]
    expected = png(folder / "rgb/000002.png")[..., ::-1]
    assert np.array_equal(frame.rgb, expected)
    np.testing.assert_allclose(frame.depth, png(folder / "depth/000002.png") / 5000.0, rtol=1e-6)
    assert (frame.depth[:4, :4] == 0).all()
    assert frame.depth.dtype == np.float32
    assert (frame.index, frame.stamp) == (2, pytest.approx(2 / 30, abs=1e-6))
    assert frame.camera == log.camera == Camera(60.0, 61.0, 31.5, 23.5, 64, 48)
    assert frame.source.endswith("000002.png")


def test_a_log_is_a_sequence(make_log: MakeLog) -> None:
    log = open_log(make_log(4))
    assert len(log) == 4
    assert [frame.index for frame in log] == [0, 1, 2, 3]
    assert log[-1].index == log.read(3).index == 3
    with pytest.raises(IndexError):
        log.read(4)
    assert log.name == "log"


def test_ground_truth_is_the_file_as_recorded(make_log: MakeLog) -> None:
    folder = make_log(4)
    truth = open_log(folder).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.positions[:, 0], [0, 0.01, 0.02, 0.03])
    (folder / "groundtruth.txt").unlink()
    assert open_log(folder).ground_truth is None


def test_float_depth_is_metres_and_nan_is_missing(make_log: MakeLog) -> None:
    folder = make_log(1)
    depth = np.full((48, 64), 1.25, np.float32)
    depth[5, 6], depth[7, 8], depth[9, 9] = np.nan, np.inf, 0
    cv2.imwrite(str(folder / "depth/000000.tiff"), depth)
    (folder / "depth.txt").write_text("0.0 depth/000000.tiff\n")
    frame = open_log(folder)[0]
    assert frame.depth[5, 6] == frame.depth[7, 8] == frame.depth[9, 9] == 0
    assert np.unique(frame.depth).tolist() == [0, 1.25]


def test_jpeg_colour_is_read(make_log: MakeLog) -> None:
    folder = make_log(1)
    cv2.imwrite(str(folder / "rgb/000000.jpg"), np.full((48, 64, 3), (30, 90, 200), np.uint8))
    (folder / "rgb.txt").write_text("0.0 rgb/000000.jpg\n")
    np.testing.assert_allclose(open_log(folder)[0].rgb.reshape(-1, 3).mean(0), [200, 90, 30], atol=2)


def test_lists_may_have_comments_blank_lines_crlf_and_a_byte_order_mark(make_log: MakeLog) -> None:
    folder = make_log(3)
    for name in ("rgb.txt", "depth.txt"):
        text = "\ufeff# a\n\n" + (folder / name).read_text() + "\n# end\n"
        (folder / name).write_bytes(text.replace("\n", "\r\n").encode())
    assert len(list(open_log(folder))) == 3


def test_association_is_one_to_one_and_closest_first() -> None:
    a = np.array([0.0, 0.010, 0.10, 0.20])
    b = np.array([0.008, 0.115, 0.12, 0.26])
    assert associate(a, b, 0.02) == [(1, 0), (2, 1)]  # 0.000 loses its neighbour to 0.010, which is closer


def test_association_equals_a_direct_transcription_of_the_rule(rng: np.random.Generator) -> None:
    for _ in range(20):
        a, b = (np.sort(rng.uniform(0, 1, 40)) for _ in range(2))
        candidates = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) < 0.02)
        left, right = set(range(40)), set(range(40))
        expected = []
        for _, i, j in candidates:
            if i in left and j in right:
                left.remove(i)
                right.remove(j)
                expected.append((i, j))
        assert associate(a, b, 0.02) == sorted(expected)


def test_a_free_running_sensor_drops_colour_without_depth_and_says_how_many(
    make_log: MakeLog, drop_line: Callable[[Path, int], str], caplog: pytest.LogCaptureFixture
) -> None:
    folder = make_log(6, depth_delay=0.012)
    drop_line(folder / "depth.txt", 4)
    with caplog.at_level(logging.WARNING):
        log = TumLog(folder)
    assert (len(log), log.unpaired) == (5, 1)
    assert "1 of 6 colour images have no depth image" in caplog.text
    assert 2 / 30 not in np.round(log.stamps, 6)
    assert [frame.index for frame in log] == [0, 1, 2, 3, 4]


def test_images_are_paired_within_the_seconds_of_the_address(make_log: MakeLog, tmp_path: Path) -> None:
    folder = make_log(4, period=0.2, depth_delay=0.05)
    with pytest.raises(LogError, match=r"pair_within=0\.05"):
        open_log(folder)
    log = open_log(f"{folder}?pair_within=0.06")
    assert [frame.depth_delay for frame in log] == pytest.approx([0.05] * 4, abs=1e-6)
    assert log.uri == f"{folder}?pair_within=0.06"
    record_mcap(log, tmp_path / "a.mcap")
    assert [frame.depth_delay for frame in open_log(tmp_path / "a.mcap")] == pytest.approx([0.05] * 4, abs=1e-6)
    for wrong in ("pair_within=0", "pair_within=nan", "pair_within=100", "pair_within=x", "pair=1"):
        with pytest.raises(LogError, match="pair"):
            open_log(f"{folder}?{wrong}")


def test_a_synchronized_log_skips_on_request(make_log: MakeLog, drop_line: Callable[[Path, int], str]) -> None:
    folder = make_log(6)
    drop_line(folder / "depth.txt", 4)
    assert len(list(open_log(folder, missing="skip"))) == 5


def test_depth_without_colour_is_only_logged(
    make_log: MakeLog, drop_line: Callable[[Path, int], str], caplog: pytest.LogCaptureFixture
) -> None:
    folder = make_log(6)
    drop_line(folder / "rgb.txt", 4)
    with caplog.at_level(logging.WARNING):
        assert len(list(open_log(folder))) == 5
    assert "1 of 6 depth images have no colour image" in caplog.text


def test_a_preset_stands_in_for_intrinsics_and_its_images_are_undistorted(make_log: MakeLog) -> None:
    folder = make_log(1)
    (folder / "intrinsics.json").unlink()
    preset = PRESETS["tum_fr1"].camera
    v, u = np.mgrid[0:480, 0:640]
    cv2.imwrite(str(folder / "rgb/000000.png"), np.dstack([0 * u, v // 2, u // 3]).astype(np.uint8))
    cv2.imwrite(str(folder / "depth/000000.png"), (5000 + u + v).astype(np.uint16))
    log = open_log(folder, camera="tum_fr1")
    frame = log[0]
    assert log.camera.distortion == ()
    assert np.array_equal(log.camera.K, preset.K)
    # OpenCV's forward model says where the ray of an undistorted pixel hit the sensor.
    pixels = np.array([[100, 80], [320, 240], [500, 400], [560, 90]])
    rays = np.column_stack([(pixels - [preset.cx, preset.cy]) / [preset.fx, preset.fy], np.ones(4)])
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), preset.K, np.array(preset.distortion))
    for (x, y), (sx, sy) in zip(pixels, seen[:, 0], strict=True):
        assert abs(sx - x) + abs(sy - y) > 0.3 or (x, y) == (320, 240)
        assert frame.rgb[y, x, 0] == pytest.approx(sx / 3, abs=1.0)
        assert frame.rgb[y, x, 1] == pytest.approx(sy / 2, abs=1.0)
        assert frame.depth[y, x] * 5000 - 5000 == pytest.approx(sx + sy, abs=1.05)


def test_depth_is_never_averaged_across_an_edge_by_undistortion(make_log: MakeLog) -> None:
    folder = make_log(1)
    values = json.loads((folder / "intrinsics.json").read_text()) | {"distortion": [0.2, -0.1, 0, 0, 0]}
    (folder / "intrinsics.json").write_text(json.dumps(values))
    step = np.where(np.arange(64)[None, :] < 32, 5000, 10000) * np.ones((48, 1))
    cv2.imwrite(str(folder / "depth/000000.png"), step.astype(np.uint16))
    assert set(np.unique(open_log(folder)[0].depth)) <= {0.0, 1.0, 2.0}


@pytest.mark.parametrize(
    ("name", "frames", "valid"),
    [("arm_wrist_48", 48, 0.85), ("apc_shelf_robot", 15, 0.26), ("visp_tabletop", 99, 0.9)],
)
def test_real_logs_open_whole(data_root: Path, name: str, frames: int, valid: float) -> None:
    log = open_log(data_root / name)
    truth = log.ground_truth
    assert len(log) == frames
    assert truth is not None
    assert len(truth) == frames
    first, last = log[0], log[-1]
    assert first.valid.mean() == pytest.approx(valid, abs=0.1)
    assert 0.1 < np.median(first.depth[first.valid]) < 5
    assert last.index == frames - 1


def test_an_unknown_folder_lists_the_known_layouts(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"rgb\.txt.*traj\.txt.*synthetic:"):
        open_log(tmp_path)
    with pytest.raises(LogError, match="does not exist"):
        open_log(tmp_path / "none")
    (tmp_path / "file").write_text("x")
    with pytest.raises(LogError, match="is a file"):
        open_log(tmp_path / "file")
