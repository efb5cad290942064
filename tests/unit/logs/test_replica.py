"""Replica as NICE-SLAM rendered it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import CameraError, LogError
from splatbot.geometry import se3_exp
from splatbot.logs import open_log

PARAMS = {"camera": {"w": 64, "h": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "scale": 6553.5}}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four frames in `room0`, cam_params.json next to it as in the published archive."""
    room = tmp_path / "room0"
    (room / "results").mkdir(parents=True)
    for i in range(4):
        cv2.imwrite(str(room / f"results/frame{i:06d}.jpg"), np.full((48, 64, 3), (20, 60, 40 * i), np.uint8))
        cv2.imwrite(str(room / f"results/depth{i:06d}.png"), np.full((48, 64), 6554 * (i + 1), np.uint16))
    (room / "traj.txt").write_text("\n".join(" ".join(f"{v:.18e}" for v in pose(i).ravel()) for i in range(4)))
    (tmp_path / "cam_params.json").write_text(json.dumps(PARAMS))
    return room


def pose(i: int) -> np.ndarray:
    return se3_exp([0.1 * i, 0.2, 0.3, 0.01 * i, 0.5, -0.2])


def test_frames_poses_and_intrinsics_are_read(folder: Path) -> None:
    log = open_log(folder)
    assert (len(log), log.name) == (4, "room0")
    assert log.camera == Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    frame = log[2]
    assert frame.stamp == pytest.approx(2 / 30)
    np.testing.assert_allclose(frame.depth, 3 * 6554 / 6553.5, rtol=1e-6)
    np.testing.assert_allclose(frame.rgb.reshape(-1, 3).mean(0), [80, 60, 20], atol=2)
    truth = log.ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, [pose(i) for i in range(4)], atol=1e-15)
    np.testing.assert_allclose(truth.stamps, [f.stamp for f in log])


def test_intrinsics_in_the_folder_itself_win(folder: Path) -> None:
    own = {"camera": PARAMS["camera"] | {"fx": 77.0}}
    (folder / "cam_params.json").write_text(json.dumps(own))
    assert open_log(folder).camera.fx == 77.0


def test_no_intrinsics_are_named_with_the_fix(folder: Path) -> None:
    (folder.parent / "cam_params.json").unlink()
    with pytest.raises(CameraError) as caught:
        open_log(folder)
    assert caught.value.file == str(folder / "cam_params.json")
    assert "scale" in (caught.value.hint or "")


@pytest.mark.parametrize(("params", "field"), [({}, "camera"), ({"camera": {"w": 64}}, "fx")])
def test_incomplete_intrinsics_are_named(folder: Path, params: dict[str, object], field: str) -> None:
    path = folder.parent / "cam_params.json"
    path.write_text(json.dumps(params))
    with pytest.raises(CameraError) as caught:
        open_log(folder)
    assert caught.value.field == field


def test_a_missing_depth_image_is_an_error_of_its_frame(folder: Path) -> None:
    (folder / "results/depth000002.png").unlink()
    log = open_log(folder)
    assert log[1].index == 1
    with pytest.raises(LogError) as caught:
        log.read(2)
    assert caught.value.file == str(folder / "results/depth000002.png")
    assert log[3].index == 3


def test_a_damaged_pose_is_named_and_frames_stay_readable(folder: Path) -> None:
    lines = (folder / "traj.txt").read_text().splitlines()
    lines[1] = lines[1].rsplit(" ", 1)[0]
    (folder / "traj.txt").write_text("\n".join(lines))
    log = open_log(folder)
    assert len(list(log)) == 4
    with pytest.raises(LogError) as caught:
        _ = log.ground_truth
    assert (caught.value.file, caught.value.field) == (str(folder / "traj.txt"), "line 2")


def test_an_empty_log_is_named(folder: Path) -> None:
    for path in (folder / "results").iterdir():
        path.unlink()
    with pytest.raises(LogError, match="empty") as caught:
        open_log(folder)
    assert caught.value.file == str(folder / "results")
