"""ChArUco boards: corners of a rendered board, and an unknown board that is found in an image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.calibration.board import CharucoBoard
from splatbot.calibration.measurements import project
from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.geometry import se3_exp

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
PIXELS = 80  # of a square in the drawing of the board


def photograph(board: CharucoBoard, T_camera_board: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Render the board by the homography of its plane, four times oversampled."""
    drawing = board._board.generateImage((board.columns * PIXELS, board.rows * PIXELS))
    scale = board.square / PIXELS
    plane = np.array([[scale, 0, scale / 2], [0, scale, scale / 2], [0, 0, 1.0]])  # of the centre of a pixel
    K = CAMERA.K.copy()
    K[:2] *= 4
    K[:2, 2] += 1.5
    H = K @ T_camera_board[:3, [0, 1, 3]] @ plane
    large = cv2.warpPerspective(drawing, H, (2560, 1920), flags=cv2.INTER_AREA, borderValue=128)
    grey = cv2.resize(cv2.GaussianBlur(large, (0, 0), 2.0), (640, 480), interpolation=cv2.INTER_AREA)
    return np.repeat(grey[..., None], 3, axis=2)


POSE = se3_exp([-0.15, -0.2, 0.8, 0.3, -0.2, 0.1])


@pytest.mark.parametrize("legacy", [False, True])
def test_corners_of_a_rendered_board_are_found_where_they_are(legacy: bool) -> None:
    board = CharucoBoard(6, 8, 0.05, 0.035, "5X5_100", legacy)
    view = board.detect(photograph(board, POSE))
    assert len(view) >= 28  # of 35
    error = np.linalg.norm(view.pixels - project(view.points, POSE, CAMERA), axis=1)
    assert error.max() < 0.3


@pytest.mark.parametrize(("dictionary", "legacy"), [("4X4_50", True), ("6X6_250", False), ("APRILTAG_36h11", False)])
def test_an_unknown_dictionary_and_pattern_are_found_in_the_image(dictionary: str, legacy: bool) -> None:
    board = CharucoBoard(6, 8, 0.05, 0.035, dictionary, legacy)
    image = photograph(board, POSE)
    found = CharucoBoard.parse("charuco:6x8:0.05:0.035").completed(image)
    assert found.legacy is legacy
    view = found.detect(image)
    assert len(view) >= 28  # of 35
    assert np.linalg.norm(view.pixels - project(view.points, POSE, CAMERA), axis=1).max() < 0.3


def test_images_without_the_board_are_refused_with_a_fix() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    with pytest.raises(InputError, match="is not in the image") as caught:
        CharucoBoard.parse("charuco:6x8:0.05:0.035").completed(noise)
    assert caught.value.hint
    assert len(CharucoBoard(6, 8, 0.05, 0.035, "5X5_100", False).detect(noise)) == 0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "chess:6x8:0.05:0.03",
        "charuco:6:0.05:0.03",
        "charuco:6x8:0.05",
        "charuco:6x8:0.03:0.05",
        "charuco:6x8:nan:0.03",
        "charuco:6x8:0.05:0.03:9X9_50",
        "charuco:1000000x8:0.05:0.03",
        "charuco:6x8:50:30",
    ],
)
def test_a_wrong_specification_is_named_with_a_fix(text: str) -> None:
    with pytest.raises(InputError) as caught:
        CharucoBoard.parse(text)
    assert caught.value.field == "board"
    assert caught.value.hint
