"""Grids of AprilTags and ArUco markers: corners of drawn boards, Kalibr's order, and boards that images complete."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.calibration.board_spec import parse_board
from splatbot.calibration.marker_grid import MarkerGrid
from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.geometry import se3_exp
from tests.unit.calibration.drawn_boards import Drawing, aruco_grid, aruco_marker, kalibr_board, photograph

Array = NDArray[np.float64]

CAMERA = Camera(600.0, 598.0, 319.5, 239.5, 640, 480, (0.03, -0.05, 0.001, -0.0005))
SIDE, GAP = 0.05, 0.015
TILTS = ([0.4, -0.3, 0.1], [-0.3, 0.4, 0.6], [0.1, 0.5, -0.4])


def project(points: Array, T: Array) -> Array:
    """Project points (N, 3) by OpenCV, the oracle."""
    rotation = cv2.Rodrigues(T[:3, :3])[0]
    return np.asarray(cv2.projectPoints(points, rotation, T[:3, 3], CAMERA.K, np.array(CAMERA.distortion))[0][:, 0])


def facing(turn: list[float], middle: tuple[float, float], distance: float, *, upwards: bool) -> Array:
    """Return T_camera_board of a board whose middle is on the axis of the camera."""
    T = se3_exp([0.0, 0.0, 0.0, *turn])
    if upwards:
        T = T @ np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = [0.0, 0.0, distance] - T[:3, :2] @ middle
    return T


def seen_kalibr(turn: list[float], *, noise: float = 2.0, distance: float = 0.55) -> tuple[NDArray[np.uint8], Array]:
    """Return a photograph of Kalibr's grid of 4x3 tags and T_camera_board in Kalibr's frame."""
    T = facing(turn, (2 * SIDE + 1.5 * GAP, 1.5 * SIDE + GAP), distance, upwards=True)
    corner = (2 * GAP, 2 * GAP + 3 * SIDE + 2 * GAP)  # lower left of tag 0 on the sheet
    return photograph(kalibr_board(4, 3, SIDE, GAP), corner, T, CAMERA, upwards=True, noise=noise), T


def seen_grid(turn: list[float], name: str, border: int = 1) -> tuple[NDArray[np.uint8], Array]:
    """Return a photograph of OpenCV's grid of 4x3 markers and T_camera_board in OpenCV's frame."""
    T = facing(turn, (2 * SIDE + 1.5 * GAP, 1.5 * SIDE + GAP), 0.55, upwards=False)
    return photograph(aruco_grid(4, 3, SIDE, GAP, name, border), (2 * GAP, 2 * GAP), T, CAMERA, upwards=False), T


@pytest.mark.parametrize("turn", TILTS)
@pytest.mark.parametrize("noise", [2.0, 6.0])
def test_corners_of_a_drawing_by_kalibrs_rules_are_found_at_the_places_of_its_documentation(
    turn: list[float], noise: float
) -> None:
    """Tag 0 is at the lower left and numbers follow to the right, then upwards; x right, y up, in tags and gaps."""
    image, T = seen_kalibr(turn, noise=noise)
    view = parse_board(f"apriltag:4x3:{SIDE}:{GAP}").completed(image).detect(image)
    assert len(view) >= 40  # of 48
    places = [(c * (SIDE + GAP) + i * SIDE, r * (SIDE + GAP) + j * SIDE) for r in range(3) for c in range(4)
              for i in range(2) for j in range(2)]  # fmt: skip
    assert {(round(1e6 * x), round(1e6 * y)) for x, y, _ in view.points} <= {
        (round(1e6 * x), round(1e6 * y)) for x, y in places
    }
    error = np.linalg.norm(view.pixels - project(view.points, T), axis=1)
    assert np.sqrt((error**2).mean()) < 0.1
    assert error.max() < 0.25


def test_the_first_corners_of_kalibrs_grid_are_those_of_tag_0() -> None:
    image, _ = seen_kalibr([0.2, -0.2, 0.0])
    board = MarkerGrid.parse(f"apriltag:4x3:{SIDE}:{GAP}").completed(image)
    assert (board.dictionary, board.border) == ("APRILTAG_36h11", 2)
    view = board.detect(image)
    low, left = view.pixels[:4, 1].max(), view.pixels[:4, 0].min()
    assert low == pytest.approx(view.pixels[:, 1].max(), abs=15)
    assert left == pytest.approx(view.pixels[:, 0].min(), abs=15)
    np.testing.assert_allclose(
        sorted(map(tuple, view.points[:4])), [(0, 0, 0), (0, SIDE, 0), (SIDE, 0, 0), (SIDE, SIDE, 0)]
    )


@pytest.mark.parametrize("turn", TILTS)
@pytest.mark.parametrize(("name", "border"), [("5X5_100", 1), ("APRILTAG_36h11", 1), ("4X4_50", 2)])
def test_corners_of_opencvs_grid_are_found(turn: list[float], name: str, border: int) -> None:
    image, T = seen_grid(turn, name, border)
    known = f":{name}" if turn is TILTS[0] else ""
    board = MarkerGrid.parse(f"grid:4x3:{SIDE}:{GAP}{known}").completed(image)
    assert board.dictionary.partition("_")[0] == name.partition("_")[0]
    assert board.border == border
    view = board.detect(image)
    assert len(view) >= 40  # of 48
    error = np.linalg.norm(view.pixels - project(view.points, T), axis=1)
    assert np.sqrt((error**2).mean()) < 0.1
    assert error.max() < 0.25


def test_points_are_those_of_opencvs_grid_board() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    exact = np.array(cv2.aruco.GridBoard((5, 7), 0.04, 0.01, dictionary).getObjPoints())
    board = MarkerGrid.parse("grid:5x7:0.04:0.01:6X6_250")
    np.testing.assert_allclose(board._points(np.arange(35)), exact, atol=1e-7)


def test_a_number_that_is_there_twice_and_one_that_is_not_on_the_board_are_left_out() -> None:
    sheet = aruco_grid(4, 3, SIDE, GAP, "5X5_100")
    pitch = SIDE + GAP
    for at, number in ((5, 3), (6, 77)):  # marker 5 is now another 3, marker 6 one of another board
        x, y = 2 * GAP + at % 4 * pitch, 2 * GAP + at // 4 * pitch
        sheet.square(x, y, SIDE, white=True)
        sheet.marker(x, y, SIDE, aruco_marker("5X5_100", number))
    T = facing([0.3, 0.2, 0.1], (0.12, 0.09), 0.55, upwards=False)
    image = photograph(sheet, (2 * GAP, 2 * GAP), T, CAMERA, upwards=False)
    view = MarkerGrid.parse(f"grid:4x3:{SIDE}:{GAP}:5X5_100").completed(image).detect(image)
    assert len(view) == 4 * 9
    assert np.linalg.norm(view.pixels - project(view.points, T), axis=1).max() < 0.25


def test_a_marker_at_another_place_is_left_out() -> None:
    sheet = aruco_grid(4, 3, SIDE, GAP, "5X5_100")
    wide = Drawing(sheet.shades.shape[1] * sheet.unit + 2 * SIDE, sheet.shades.shape[0] * sheet.unit, sheet.unit)
    wide.shades[:, : sheet.shades.shape[1]] = sheet.shades
    last = 2 * GAP + 3 * (SIDE + GAP)
    wide.square(last, 2 * GAP, SIDE, white=True)
    wide.marker(last + SIDE + GAP, 2 * GAP, SIDE, aruco_marker("5X5_100", 3))  # a column further to the right
    T = facing([0.2, 0.2, 0.0], (0.15, 0.09), 0.65, upwards=False)
    image = photograph(wide, (2 * GAP, 2 * GAP), T, CAMERA, upwards=False)
    view = MarkerGrid.parse(f"grid:4x3:{SIDE}:{GAP}:5X5_100").completed(image).detect(image)
    assert len(view) == 4 * 11


def test_images_without_the_board_are_refused_with_a_fix() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    for spec in ("apriltag:4x3:0.05:0.015", "grid:4x3:0.05:0.015"):
        with pytest.raises(InputError, match="is not in the image") as caught:
            parse_board(spec).completed(noise)
        assert caught.value.hint
    assert len(MarkerGrid(4, 3, 0.05, 0.015, dictionary="5X5_50", border=1).detect(noise)) == 0
    with pytest.raises(InputError, match="is not complete"):
        MarkerGrid(4, 3, 0.05, 0.015).detect(noise)


def test_names_of_families_and_dictionaries_are_those_of_their_makers() -> None:
    for name in ("36h11", "t36h11", "APRILTAG_36h11", "apriltag_36H11"):
        assert MarkerGrid.parse(f"apriltag:6x6:0.088:0.0264:{name}").dictionary == "APRILTAG_36h11"
    for name in ("6X6_250", "DICT_6X6_250", "6x6_250"):
        assert MarkerGrid.parse(f"grid:6x6:0.04:0.01:{name}").dictionary == "6X6_250"
    assert MarkerGrid.parse("grid:6x6:0.04:0.01:APRILTAG_36h11").dictionary == "APRILTAG_36h11"


@pytest.mark.parametrize(
    "text",
    [
        "apriltag",
        "apriltag:6:0.05:0.01",
        "apriltag:6x6:0.05",
        "apriltag:6x6:0.05:0",
        "apriltag:6x6:nan:0.01",
        "apriltag:6x6:0.05:0.01:36h11:more",
        "apriltag:6x6:0.05:0.01:5X5_100",
        "apriltag:6x6:0.05:0.01:16h5",  # has 30 tags
        "apriltag:1000x6:0.05:0.01",
        "grid:1x1:0.05:0.01",
        "grid:5x7:50:10",
        "grid:8x7:0.05:0.01:4X4_50",
        "grid:5x7:0.04:0.01:9X9_50",
        "circles:5x7:0.04",
    ],
)
def test_a_wrong_specification_is_named_with_a_fix(text: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_board(text)
    assert caught.value.field == "board"
    assert caught.value.hint
