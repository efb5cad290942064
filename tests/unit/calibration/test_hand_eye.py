"""Hand-eye calibration: exact in closed form, honest about noise, offsets and undetermined values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.calibration.board import BoardView, CharucoBoard
from splatbot.calibration.hand_eye import calibrate_hand_eye, closed_form
from splatbot.calibration.intrinsics import calibrate_intrinsics
from splatbot.calibration.link_motion import JointLinkMotion, PoseLinkMotion, check_joints
from splatbot.calibration.measurements import BoardMeasurement, PoseMeasurement, project
from splatbot.calibration.views import ViewSource, find_board
from splatbot.camera import Camera
from splatbot.collision import RobotSpheres
from splatbot.errors import InputError
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.robots.panda import panda

Array = NDArray[np.float64]

ARM = RobotSpheres(panda())
NAMES = panda().chain.names
CAMERA = Camera(610.0, 610.0, 320.0, 240.0, 640, 480, (0.05, -0.1, 0.001, 0.0, 0.0))
X = se3_exp([0.05, 0.02, 0.08, 0.1, -0.2, 1.5])
OFFSETS = np.array([0.0, 0.0, 0.010, 0.0, -0.010, 0.0, 0.0])


def link_poses(q: Array) -> Array:
    """Compute the poses (N, 4, 4) of the last link by the robot's own kinematics, an independent oracle."""
    return np.asarray(panda().fk(q)[:, 7])


def postures(count: int, spread: float, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.asarray(panda().home + rng.uniform(-spread, spread, (count, 7)))


def tracked(count: int, offsets: Array, noise: tuple[float, float], seed: int) -> tuple[Array, Array, Array]:
    """Return joints as measured, noisy poses in a map, and the map's pose in the base."""
    q = postures(count, 0.5, seed)
    Y = se3_exp([0.4, -0.1, 0.3, 0.5, 0.3, -0.2])
    T = inverse(Y) @ link_poses(q + offsets) @ X
    rng = np.random.default_rng(seed + 1)
    noisy = [t @ se3_exp(np.r_[rng.normal(0, noise[0], 3), rng.normal(0, noise[1], 3)]) for t in T]
    return q, np.array(noisy), Y


def seen_board(count: int, offsets: Array, seed: int, *, eye_in_hand: bool) -> tuple[Array, BoardMeasurement, Array]:
    """Return joints as measured, views of a board with 0.2 px of noise, and the pose of the static frame."""
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(6)), -1).reshape(-1, 2)
    points = np.column_stack([0.04 * (grid - grid.mean(axis=0)), np.zeros(len(grid))])
    middle = link_poses(panda().home[None] + offsets)[0] @ X
    T_camera_board = se3_exp([0.0, 0.0, 0.6, 0.2, -0.1, 0.3])
    Y = middle @ (T_camera_board if eye_in_hand else inverse(T_camera_board))
    rng = np.random.default_rng(seed + 1)
    joints, views = [], []
    for q in postures(2000, 0.5, seed):
        T = inverse(Y) @ link_poses((q + offsets)[None])[0] @ X
        T_camera_board = inverse(T) if eye_in_hand else T
        pixels = project(points, T_camera_board, CAMERA)
        if T_camera_board[2, 3] > 0.3 and ((pixels > 0) & (pixels < [640, 480])).all():
            joints.append(q)
            views.append(BoardView(points, pixels + rng.normal(0, 0.2, pixels.shape)))
    assert len(views) >= count
    return np.array(joints[:count]), BoardMeasurement(tuple(views[:count]), CAMERA, eye_in_hand), Y


def pose_error(found: Array, truth: Array) -> Array:
    return se3_log(inverse(truth) @ found)


def test_the_closed_form_is_exact_without_noise() -> None:
    q, T, Y = tracked(12, np.zeros(7), (0.0, 0.0), 3)
    found_X, found_Y = closed_form(link_poses(q), T)
    assert np.abs(found_X - X).max() < 1e-9
    assert np.abs(found_Y - Y).max() < 1e-9


def test_motion_by_joints_is_that_of_the_robot() -> None:
    q = postures(5, 1.0, 0)
    for link in (1, 4, 7):
        found = JointLinkMotion(ARM, q, link).poses(0.1 * np.ones(link), 0.0)
        moved = q + 0.1 * (np.arange(7) < link)
        assert np.abs(found - panda().fk(moved)[:, link]).max() < 1e-12


@pytest.mark.parametrize("eye_in_hand", [True, False])
def test_views_of_a_board_give_the_camera_and_the_offsets_within_three_sigma(eye_in_hand: bool) -> None:
    q, measured, Y = seen_board(30, OFFSETS, 5, eye_in_hand=eye_in_hand)
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), measured)
    assert len(found.held_out) == 2
    without, with_offsets = found.held_out.values()
    assert with_offsets < 0.5 < without
    assert (np.abs(pose_error(found.T_link_moving, X)) < 3 * found.sigma_moving).all()
    assert (np.abs(pose_error(found.T_base_static, Y)) < 3 * found.sigma_static).all()
    for k, (name, estimate) in enumerate(found.offsets.items()):
        assert name == NAMES[k]
        assert bool(estimate.refusal) == (k in (0, 6)), estimate
        assert abs(estimate.value - OFFSETS[k]) < 3 * estimate.sigma
    assert np.abs(found.joint_offsets - OFFSETS).max() < 0.001
    assert np.linalg.norm(pose_error(found.T_link_moving, X)[:3]) < 0.001


def test_tracked_poses_give_offsets_of_ten_milliradians_within_one_and_the_camera_within_a_millimetre() -> None:
    q, T, _ = tracked(300, OFFSETS, (0.001, 0.001), 8)
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), PoseMeasurement(T))
    assert np.abs(found.joint_offsets - OFFSETS).max() < 0.001
    assert np.linalg.norm(pose_error(found.T_link_moving, X)[:3]) < 0.001


def test_an_arm_without_offsets_gets_none() -> None:
    q, T, _ = tracked(60, np.zeros(7), (0.001, 0.001), 2)
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), PoseMeasurement(T))
    assert found.offsets == {}
    assert not found.joint_offsets.any()


def test_standard_deviations_cover_the_errors() -> None:
    """NEES of X: six degrees of freedom on average, between half and twice as many."""
    values = []
    for seed in range(0, 40, 2):
        q, T, _ = tracked(30, np.zeros(7), (0.003, 0.004), 100 + seed)
        found = calibrate_hand_eye(PoseLinkMotion(link_poses(q)), PoseMeasurement(T))
        values.append(np.mean((pose_error(found.T_link_moving, X) / found.sigma_moving) ** 2))
    assert 0.5 < np.mean(values) < 2.0


def test_offsets_of_the_first_and_the_last_joint_change_nothing_that_is_seen() -> None:
    q, T, _ = tracked(40, np.zeros(7), (0.0, 0.0), 4)
    moved = q - np.array([0.03, 0, 0, 0, 0, 0, -0.02])
    found = calibrate_hand_eye(JointLinkMotion(ARM, moved, 7), PoseMeasurement(T), offsets=True)
    assert found.error < 1e-3  # [mm]: they are in the poses of the map and of the camera
    assert np.abs(found.joint_offsets).max() < 1e-4
    assert "base" in found.offsets[NAMES[0]].refusal
    assert "hand" in found.offsets[NAMES[6]].refusal


def test_a_joint_that_hardly_matters_is_refused() -> None:
    """Joints 2 to 6 at rest: only the first and the last move, so the offsets of the others look alike."""
    rng = np.random.default_rng(0)
    q = np.tile(panda().home, (30, 1))
    q[:, [0, 6]] += rng.uniform(-0.6, 0.6, (30, 2))
    T = link_poses(q) @ X
    T = np.array([t @ se3_exp(rng.normal(0, 0.001, 6)) for t in T])
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), PoseMeasurement(T), offsets=True)
    assert sum(bool(e.refusal) for e in found.offsets.values()) >= 5
    assert np.abs(found.joint_offsets).max() < 0.002  # the truth is 0


def test_without_a_refused_offset_the_pose_on_the_link_is_that_of_the_written_offsets() -> None:
    """Refused offsets are 0 in the solution, so that offsets and pose as they are written predict the views."""
    rng = np.random.default_rng(3)
    q = np.tile(panda().home, (40, 1))
    q[:, [0, 2, 6]] += rng.uniform(-0.5, 0.5, (40, 3))
    T = link_poses(q + OFFSETS) @ X
    T = np.array([t @ se3_exp(rng.normal(0, 0.001, 6)) for t in T])
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), PoseMeasurement(T), offsets=True)
    assert any(e.refusal for e in list(found.offsets.values())[1:-1])
    predicted = inverse(found.T_base_static) @ link_poses(q + found.joint_offsets) @ found.T_link_moving
    assert 1e3 * np.median(np.linalg.norm(predicted[:, :3, 3] - T[:, :3, 3], axis=1)) == pytest.approx(found.error)


def test_offsets_that_trade_off_are_covered_by_their_standard_deviations() -> None:
    """Axes 3 and 5 are nearly parallel while joint 4 is near 0: only the sum of their offsets is determined."""
    rng = np.random.default_rng(5)
    q = panda().home + rng.uniform(-0.6, 0.6, (60, 7))
    q[:, 3] = -0.1 + rng.uniform(-0.01, 0.01, 60)
    truth = np.array([0.0, 0.0, 0.010, 0.0, -0.010, 0.0, 0.0])
    T = link_poses(q + truth) @ X
    T = np.array([t @ se3_exp(rng.normal(0, 0.002, 6)) for t in T])
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), PoseMeasurement(T), offsets=True)
    for estimate, value in zip(found.offsets.values(), truth, strict=True):
        assert estimate.refusal or abs(estimate.value - value) < 3 * estimate.sigma
    assert (np.abs(pose_error(found.T_link_moving, X)) < 3 * found.sigma_moving).all()


@pytest.mark.long
@pytest.mark.parametrize("error", [0.0002, 0.005])
def test_standard_deviations_of_boards_cover_the_errors_of_a_good_and_of_a_bad_arm(error: float) -> None:
    """NEES of X, six degrees of freedom on average, for arms that err by 0.2 and 5 mm and milliradians."""
    values = []
    for seed in range(8):
        q, measured, _ = seen_board(16, np.zeros(7), 30 + seed, eye_in_hand=True)
        rng = np.random.default_rng(seed)
        F = link_poses(q)
        F = np.array([f @ se3_exp(rng.normal(0, error, 6)) for f in F])
        found = calibrate_hand_eye(PoseLinkMotion(F), measured)
        values.append(np.mean((pose_error(found.T_link_moving, X) / found.sigma_moving) ** 2))
    assert 0.2 < np.mean(values) < 2.5


def printed(measured: BoardMeasurement, scale: float) -> BoardMeasurement:
    """Return views of a board that is printed larger by a scale than its description states."""
    return replace(measured, views=tuple(BoardView(view.points / scale, view.pixels) for view in measured.views))


@pytest.mark.long
@pytest.mark.parametrize("eye_in_hand", [True, False])
@pytest.mark.parametrize(("offsets", "scale"), [(np.zeros(7), 1.03), (OFFSETS, 0.9)])
def test_a_board_of_another_scale_gives_it_and_the_camera_within_three_sigma(
    eye_in_hand: bool, offsets: Array, scale: float
) -> None:
    q, measured, Y = seen_board(30, offsets, 5, eye_in_hand=eye_in_hand)
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), printed(measured, scale), scale=None)
    assert found.scale is not None
    assert not found.scale.refusal
    assert abs(found.scale.value - scale) < 3 * found.scale.sigma
    assert found.scale.sigma < 0.003
    assert bool(found.offsets) == offsets.any()
    assert (np.abs(pose_error(found.T_link_moving, X)) < 3 * found.sigma_moving).all()
    assert (np.abs(pose_error(found.T_base_static, Y)) < 3 * found.sigma_static).all()


def test_a_board_in_inches_is_found() -> None:
    q, measured, _ = seen_board(20, np.zeros(7), 5, eye_in_hand=True)
    found = calibrate_hand_eye(PoseLinkMotion(link_poses(q)), printed(measured, 2.54), scale=None)
    assert found.scale is not None
    assert abs(found.scale.value - 2.54) < 3 * found.scale.sigma


def test_a_board_of_the_given_size_has_no_scale() -> None:
    q, measured, _ = seen_board(30, OFFSETS, 5, eye_in_hand=True)
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), measured, scale=None)
    assert found.scale is None
    assert len(found.held_out) == 4


def test_a_map_of_another_scale_gives_it_within_three_sigma() -> None:
    q, T, _ = tracked(60, np.zeros(7), (0.001, 0.001), 2)
    T[:, :3, 3] /= 0.98  # depth that is too large
    found = calibrate_hand_eye(PoseLinkMotion(link_poses(q)), PoseMeasurement(T), scale=None)
    assert found.scale is not None
    assert abs(found.scale.value - 0.98) < 3 * found.scale.sigma
    assert np.linalg.norm(pose_error(found.T_link_moving, X)[:3]) < 0.001


@pytest.mark.long
def test_standard_deviations_of_the_scale_cover_its_errors() -> None:
    """NEES of the scale, one degree of freedom on average, for an arm that errs by 0.3 mm and milliradians."""
    values = []
    for seed in range(10):
        q, measured, _ = seen_board(24, np.zeros(7), 60 + seed, eye_in_hand=True)
        rng = np.random.default_rng(seed)
        F = np.array([f @ se3_exp(rng.normal(0, 0.0003, 6)) for f in link_poses(q)])
        found = calibrate_hand_eye(PoseLinkMotion(F), printed(measured, 1.05), scale=True)
        assert found.scale is not None
        values.append(((found.scale.value - 1.05) / found.scale.sigma) ** 2)
    assert 0.2 < np.mean(values) < 2.5


def test_turns_about_one_point_do_not_determine_the_scale() -> None:
    """A link that turns about a point moves the camera as if around a smaller circle before a smaller board."""
    rng = np.random.default_rng(4)
    F = np.array([se3_exp([0, 0, 0, *rng.uniform(-0.5, 0.5, 3)]) for _ in range(30)])
    Y = se3_exp([0.0, 0.0, 1.0, 0.1, 0.2, 0.0])
    T = np.array([t @ se3_exp(rng.normal(0, 0.001, 6)) for t in inverse(Y) @ F @ X])
    with pytest.raises(InputError, match="is not determined") as caught:
        calibrate_hand_eye(PoseLinkMotion(F), PoseMeasurement(T), scale=True)
    assert caught.value.field == "scale"
    assert "shift the camera" in str(caught.value.hint)
    found = calibrate_hand_eye(PoseLinkMotion(F), PoseMeasurement(T), scale=None)
    assert found.scale is None or found.scale.refusal


@pytest.mark.long
def test_inverted_poses_and_a_wrong_square_are_refused() -> None:
    q, measured, _ = seen_board(20, np.zeros(7), 2, eye_in_hand=True)
    F = link_poses(q)
    double = tuple(BoardView(2 * view.points, view.pixels) for view in measured.views)
    for motion, seen in (
        (PoseLinkMotion(np.array([inverse(f) for f in F])), measured),
        (PoseLinkMotion(F), replace(measured, eye_in_hand=False)),
        (PoseLinkMotion(F), replace(measured, views=double)),
    ):
        with pytest.raises(InputError, match="disagree by") as caught:
            calibrate_hand_eye(motion, seen).check(moving=True, static=False)
        assert "side of a square" in str(caught.value.hint)


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (np.zeros((3, 6)), "has 6 joints, panda has 7"),
        (np.full((3, 7), np.nan), "not finite"),
        (np.degrees(np.tile(panda().home, (3, 1))), "its limits are"),
    ],
)
def test_joints_that_cannot_be_those_of_the_arm_are_refused(joints: Array, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        check_joints(panda(), joints, file="joints.txt")
    assert caught.value.hint


def test_turns_about_one_axis_only_are_refused() -> None:
    q = np.tile(panda().home, (20, 1))
    q[:, 6] += np.linspace(-1, 1, 20)
    with pytest.raises(InputError, match="turns about one axis only") as caught:
        closed_form(link_poses(q), link_poses(q) @ X)
    assert "two axes" in str(caught.value.hint)


def test_an_arm_at_rest_is_refused() -> None:
    F = link_poses(np.tile(panda().home, (8, 1)))
    with pytest.raises(InputError, match="turns about one axis only"):
        calibrate_hand_eye(PoseLinkMotion(F), PoseMeasurement(F @ X))


def test_three_views_are_too_few() -> None:
    F = link_poses(postures(3, 0.3, 0))
    with pytest.raises(InputError, match="3 usable views"):
        calibrate_hand_eye(PoseLinkMotion(F), PoseMeasurement(F @ X))


def test_two_views_of_twenty_with_wrong_poses_do_not_move_the_camera() -> None:
    q, T, _ = tracked(20, np.zeros(7), (0.001, 0.001), 6)
    T[[3, 12]] = T[[3, 12]] @ se3_exp([0.1, -0.05, 0.2, 0.2, 0.1, -0.3])
    found = calibrate_hand_eye(PoseLinkMotion(link_poses(q)), PoseMeasurement(T))
    assert np.linalg.norm(pose_error(found.T_link_moving, X)[:3]) < 0.004


def test_a_time_offset_is_recovered_within_three_sigma() -> None:
    rng = np.random.default_rng(1)
    times = np.arange(0, 20, 0.01)
    q = panda().home + 0.4 * np.sin(times[:, None] * rng.uniform(0.5, 1.5, 7) + rng.uniform(0, 6, 7))
    at = np.arange(1.0, 19.0, 1 / 30)
    true = np.column_stack([np.interp(at + 0.0432, times, x) for x in q.T])
    T = link_poses(true) @ X
    T = np.array([t @ se3_exp(rng.normal(0, 0.002, 6)) for t in T])
    for motion in (JointLinkMotion(ARM, q, 7, times, at), PoseLinkMotion(link_poses(q), times, at)):
        found = calibrate_hand_eye(motion, PoseMeasurement(T), offsets=False, delay=0.0)
        assert found.delay is not None
        assert not found.delay.refusal
        assert abs(found.delay.value - 0.0432) < 3 * found.delay.sigma
        assert found.delay.sigma < 0.002


def test_joint_offsets_bring_a_recorded_arm_to_a_pixel_on_views_held_out(data_root: Path) -> None:
    board, source = CharucoBoard.parse("charuco:10x14:0.07:0.04"), ViewSource(str(data_root / "panda_charuco_32"))
    recording = find_board(source, board, max_views=100, on_share=lambda share: None)
    camera = calibrate_intrinsics(recording.views, recording.size).camera
    measured = BoardMeasurement(tuple(recording.views), camera, True)
    found = calibrate_hand_eye(JointLinkMotion(ARM, np.array([arm.joints for arm in recording.arms]), 7), measured)
    without, with_offsets = found.held_out.values()
    assert without <= 1.8
    assert with_offsets <= 1.1
    known = {name: e for name, e in found.offsets.items() if not e.refusal}
    assert list(known) == list(NAMES[1:6])
    assert all(e.sigma < 0.004 for e in known.values())


def test_predictions_behind_the_camera_do_not_end_the_solution() -> None:
    """A start far from the truth predicts the board behind the camera; the solution is still found."""
    q, measured, _ = seen_board(20, np.zeros(7), 9, eye_in_hand=True)
    wrong = replace(measured, camera=Camera(900.0, 300.0, 320.0, 240.0, 640, 480))
    found = calibrate_hand_eye(JointLinkMotion(ARM, q, 7), wrong, offsets=False)
    assert np.isfinite(found.T_link_moving).all()
    assert found.error > 2.0  # and the wrong camera shows
