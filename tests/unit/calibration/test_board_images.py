"""Calibrations from photographs of drawn boards: camera and hand-eye pose within their standard deviations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.calibration.board import Board, BoardView
from splatbot.calibration.board_spec import parse_board
from splatbot.calibration.hand_eye import calibrate_hand_eye
from splatbot.calibration.intrinsics import calibrate_intrinsics
from splatbot.calibration.link_motion import PoseLinkMotion
from splatbot.calibration.measurements import BoardMeasurement
from splatbot.camera import Camera
from splatbot.geometry import inverse, se3_exp, se3_log
from tests.unit.calibration.drawn_boards import aruco_grid, kalibr_board, photograph

Array = NDArray[np.float64]

CAMERA = Camera(512.0, 509.0, 322.0, 238.0, 640, 480, (0.06, -0.1, 0.001, -0.001, 0.0))
TAG, GAP, COLUMNS, ROWS = 0.04, 0.012, 4, 3
WIDTH, HEIGHT = COLUMNS * (TAG + GAP) - GAP, ROWS * (TAG + GAP) - GAP
X = se3_exp([0.05, 0.02, 0.08, 0.1, -0.2, 1.5])


def poses(count: int, seed: int) -> list[Array]:
    """Return poses T_camera_board (4, 4) of Kalibr's frame, with the board in all parts of the image."""
    rng = np.random.default_rng(seed)
    flip, found = np.diag([1.0, -1.0, -1.0, 1.0]), []
    for _ in range(count):
        T = se3_exp([0, 0, 0, *rng.uniform(-0.55, 0.55, 2), rng.uniform(-1.5, 1.5)]) @ flip
        T[:3, 3] = [rng.uniform(-0.06, 0.06), rng.uniform(-0.05, 0.05), rng.uniform(0.28, 0.4)]
        T[:3, 3] -= T[:3, :2] @ [WIDTH / 2, HEIGHT / 2]
        found.append(T)
    return found


def kalibr_views(seen: list[Array]) -> list[BoardView]:
    """Return the corners that are found in photographs of Kalibr's grid."""
    drawing, corner = kalibr_board(COLUMNS, ROWS, TAG, GAP), (2 * GAP, 2 * GAP + HEIGHT)
    board: Board = parse_board(f"apriltag:{COLUMNS}x{ROWS}:{TAG}:{GAP}:36h11")
    images = [photograph(drawing, corner, T, CAMERA, upwards=True, seed=k) for k, T in enumerate(seen)]
    board = board.completed(images[0])
    return [board.detect(image) for image in images]


@pytest.fixture(scope="module")
def seen() -> list[Array]:
    return poses(18, 3)


@pytest.fixture(scope="module")
def views(seen: list[Array]) -> list[BoardView]:
    return kalibr_views(seen)


def test_a_camera_is_recovered_from_photographs_of_kalibrs_grid(views: list[BoardView]) -> None:
    found = calibrate_intrinsics(views, (640, 480))
    found.check()
    assert found.rms < 0.15
    truth = dict(zip(found.estimates, (512, 509, 322, 238, *CAMERA.distortion), strict=True))
    for name, estimate in found.estimates.items():
        assert abs(estimate.value - truth[name]) <= 3 * estimate.sigma, name
    assert abs(found.camera.fx - 512) < 1.0


def test_a_hand_eye_pose_is_recovered_from_photographs_of_kalibrs_grid(
    seen: list[Array], views: list[BoardView]
) -> None:
    Y = se3_exp([0.5, -0.1, 0.2, 0.4, 0.1, -0.3])
    links = np.array([Y @ inverse(T) @ inverse(X) for T in seen])
    found = calibrate_hand_eye(PoseLinkMotion(links), BoardMeasurement(tuple(views), CAMERA, True))
    error = se3_log(inverse(X) @ found.T_link_moving)
    assert (np.abs(error) < 3 * found.sigma_moving).all()
    assert np.linalg.norm(error[:3]) < 0.001
    assert (np.abs(se3_log(inverse(Y) @ found.T_base_static)) < 3 * found.sigma_static).all()


def test_a_camera_is_recovered_from_photographs_of_opencvs_grid(seen: list[Array]) -> None:
    drawing = aruco_grid(COLUMNS, ROWS, TAG, GAP, "5X5_50")
    board: Board = parse_board(f"grid:{COLUMNS}x{ROWS}:{TAG}:{GAP}:5X5_50")
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[1, 3] = HEIGHT
    images = [photograph(drawing, (2 * GAP, 2 * GAP), T @ down, CAMERA, upwards=False) for T in seen]
    board = board.completed(images[0])
    found = calibrate_intrinsics([board.detect(image) for image in images], (640, 480))
    found.check()
    assert found.rms < 0.15
    assert abs(found.camera.fx - 512) < min(1.0, 3 * found.estimates["fx"].sigma)
