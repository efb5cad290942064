"""Intrinsics from views of a board: recovered within the stated standard deviations, refused where undetermined."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.calibration.board import BoardView, CharucoBoard
from splatbot.calibration.intrinsics import calibrate_intrinsics
from splatbot.calibration.measurements import project
from splatbot.calibration.views import ViewSource, find_board
from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.geometry import se3_exp

CAMERA = Camera(612.0, 608.0, 322.0, 236.0, 640, 480, (0.08, -0.15, 0.001, -0.002, 0.05))


def views(count: int, noise: float, *, tilt: float = 0.4, seed: int = 0) -> list[BoardView]:
    """Return views of a board with 9x6 corners of 4 cm from random sides."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(6)), -1).reshape(-1, 2)
    points = np.column_stack([0.04 * (grid - grid.mean(axis=0)), np.zeros(len(grid))])
    found = []
    for _ in range(count):
        xi = [*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.45, 0.7), *rng.uniform(-tilt, tilt, 3)]
        pixels = project(points, se3_exp(xi), CAMERA)
        inside = ((pixels > 5) & (pixels < [634, 474])).all(axis=1)
        found.append(BoardView(points[inside], (pixels + rng.normal(0, noise, pixels.shape))[inside]))
    return found


def test_a_camera_is_recovered_within_three_standard_deviations() -> None:
    found = calibrate_intrinsics(views(25, 0.1), (640, 480))
    assert found.rms == pytest.approx(0.14, abs=0.02)  # 0.1 px in both directions
    truth = dict(zip(found.estimates, (612, 608, 322, 236, *CAMERA.distortion), strict=True))
    for name, estimate in found.estimates.items():
        assert not estimate.refusal
        assert abs(estimate.value - truth[name]) <= 3 * estimate.sigma, name
    assert found.estimates["fx"].sigma < 1.0


def test_boards_parallel_to_the_image_do_not_determine_the_focal_length() -> None:
    flat = calibrate_intrinsics(views(12, 0.3, tilt=0.0), (640, 480))
    tilted = calibrate_intrinsics(views(12, 0.3), (640, 480))
    assert flat.estimates["fx"].sigma > 5 * tilted.estimates["fx"].sigma
    assert "tilt the board" in flat.estimates["fx"].refusal


def test_too_few_views_are_refused_with_their_number() -> None:
    few = [*views(5, 0.1), BoardView(np.zeros((3, 3)), np.zeros((3, 2)))]
    with pytest.raises(InputError, match="5 of 6 images"):
        calibrate_intrinsics(few, (640, 480))


def test_the_recorded_board_fits_to_an_eighth_of_a_pixel(data_root: Path) -> None:
    board, source = CharucoBoard.parse("charuco:10x14:0.07:0.04"), ViewSource(str(data_root / "panda_charuco_32"))
    recording = find_board(source, board, max_views=12, on_share=lambda share: None)
    found = calibrate_intrinsics(recording.views, recording.size)
    assert found.rms < 0.15
    assert found.camera.fx == pytest.approx(614.7, abs=2.0)
