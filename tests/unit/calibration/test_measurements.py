"""Poses of a board in images of a fisheye."""

from __future__ import annotations

import numpy as np

from splatbot.calibration.board import BoardView
from splatbot.calibration.measurements import board_pose, project
from splatbot.geometry import se3_exp, transform_points
from tests.lenses import FISHEYE, fisheye_pixels


def test_the_pose_of_a_board_in_a_fisheye_image_is_exact() -> None:
    x, y = np.mgrid[:7, :5] * 0.04
    points = np.stack([x.ravel(), y.ravel(), np.zeros(35)], -1)
    T = se3_exp([-0.1, -0.05, 0.2, 0.4, -0.3, 0.2])
    pixels = fisheye_pixels(FISHEYE, transform_points(T, points))
    found = board_pose(BoardView(points, pixels), FISHEYE)
    np.testing.assert_allclose(found, T, atol=1e-6)
    np.testing.assert_allclose(project(points, T, FISHEYE), pixels, atol=1e-9)
