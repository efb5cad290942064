"""Frames of further cameras go into the map of the first one, at poses that are given, estimated or tracked."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.config import CameraConfig, Config, MappingConfig
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import inverse, se3_exp
from splatbot.logs.synthetic import SyntheticLog
from splatbot.mapping.further_camera import MountedCamera
from splatbot.mapping.keyframes import NUMBERS
from splatbot.run.rollback import rolled_back
from splatbot.slam import Slam
from splatbot.tracking.nearby_keyframes import pose_distance
from tests.several_cameras import WRONG, estimated, frames_of, in_order, in_world, pose_config, side_view, wrist_log

FRAMES = 20
T_FIRST_CARRIED = se3_exp(np.array([0.05, -0.02, 0.01, 0.1, -0.15, 0.05]))


@cache
def wrist() -> SyntheticLog:
    return wrist_log(FRAMES, width=240, height=180)


@cache
def table_pose() -> NDArray[np.float64]:
    """Return T_scene_camera (4, 4) of a fixed camera."""
    return side_view(wrist(), np.radians(40), 0.1)


@cache
def table_frames() -> list[Frame]:
    stamps = [k / 30 + 0.01 for k in range(FRAMES)]
    return frames_of(wrist(), [table_pose()] * FRAMES, stamps, "table", sigma_depth=0.002)


def processed(camera: CameraConfig, frames: list[Frame], name: str = "table", **settings: MappingConfig) -> Slam:
    slam = Slam(Config(cameras={name: camera}, **settings))
    for frame in in_order(wrist(), frames):
        slam.process(frame)
    return slam


def first_camera_error(slam: Slam) -> float:
    truth = [in_world(wrist(), T) for T in wrist().ground_truth.T_world_camera]
    return max(pose_distance(a, b)[0] for a, b in zip(truth, slam.trajectory.T_world_camera, strict=True))


@cache
def alone() -> Slam:
    slam = Slam(Config())
    for frame in wrist():
        slam.process(frame)
    return slam


def test_a_fixed_camera_with_a_wrong_pose_is_estimated_and_mapped_and_the_first_one_is_as_accurate_as_alone() -> None:
    T = in_world(wrist(), table_pose())
    slam = processed(estimated(T @ WRONG, fixed=True), table_frames())
    camera = slam.further_cameras["table"]
    assert isinstance(camera, MountedCamera)
    assert camera.pose.known
    moved, turned = pose_distance(T, camera.pose.T_parent_camera)
    assert moved < 2e-3
    assert turned < np.radians(0.2)
    keyframes = [k for k in slam.keyframes if k.camera_name]
    assert [k.number for k in keyframes] == [NUMBERS]
    assert keyframes[0].camera.width == 320
    assert int((slam.snapshot().model.anchors >= NUMBERS).sum()) > 500
    assert len(slam.trajectory) == FRAMES
    assert len(slam.trajectory_of("table")) == FRAMES - 7  # eight frames determine the pose, the last of them has it
    assert first_camera_error(slam) < first_camera_error(alone()) + 5e-4


def test_an_exact_pose_is_used_from_the_first_frame_on() -> None:
    T = in_world(wrist(), table_pose())
    slam = processed(CameraConfig(T_world_camera=pose_config(T)), table_frames()[:2])
    poses = slam.trajectory_of("table").T_world_camera
    assert len(poses) == 2
    assert np.allclose(poses, T, atol=1e-9)


def test_a_carried_camera_is_estimated_on_the_first_one() -> None:
    poses = [T @ T_FIRST_CARRIED for T in wrist().ground_truth.T_world_camera]
    frames = frames_of(wrist(), poses, wrist().stamps, "side", sigma_depth=0.002)
    slam = processed(estimated(T_FIRST_CARRIED @ WRONG, fixed=False), frames, "side")
    camera = slam.further_cameras["side"]
    assert isinstance(camera, MountedCamera)
    assert camera.pose.known
    moved, turned = pose_distance(T_FIRST_CARRIED, camera.pose.T_parent_camera)
    assert moved < 2e-3
    assert turned < np.radians(0.2)
    found = slam.trajectory_of("side")
    truth = [in_world(wrist(), T) for T in poses[-len(found) :]]
    assert max(pose_distance(a, b)[0] for a, b in zip(truth, found.T_world_camera, strict=True)) < 3e-3


def test_a_free_camera_is_found_in_the_map_and_tracked() -> None:
    poses = [T @ se3_exp(np.array([0.03, 0.0, 0.0, 0.0, 0.05, 0.0])) for T in wrist().ground_truth.T_world_camera]
    frames = frames_of(wrist(), poses, wrist().stamps, "head", width=240)
    slam = processed(CameraConfig(), frames, "head")
    found = slam.trajectory_of("head")
    assert len(found) > FRAMES / 2
    truth = [in_world(wrist(), T) for T in poses[-len(found) :]]
    assert max(pose_distance(a, b)[0] for a, b in zip(truth, found.T_world_camera, strict=True)) < 3e-3


def test_a_camera_that_moves_but_is_called_fixed_is_not_mapped() -> None:
    poses = [table_pose() @ se3_exp(np.array([0.004 * k, 0, 0, 0, 0, 0])) for k in range(FRAMES)]
    frames = frames_of(wrist(), poses, [k / 30 + 0.01 for k in range(FRAMES)], "table")
    slam = processed(estimated(in_world(wrist(), poses[0]), fixed=True), frames)
    results = [r for r in slam.results if r.camera_name]
    assert {r.verdict for r in results} == {"lost"}
    assert "contradict" in results[-1].reasons[0]
    assert not any(k.camera_name for k in slam.keyframes)


def test_a_frame_of_an_unknown_camera_or_of_another_size_is_refused_and_the_map_goes_on() -> None:
    slam = Slam(Config(cameras={"table": CameraConfig(T_world_camera=pose_config(np.eye(4)))}))
    slam.process(wrist()[0])
    with pytest.raises(InputError, match="is 'shelf'"):
        slam.process(replace(table_frames()[0], camera_name="shelf"))
    slam.process(table_frames()[0])
    small = frames_of(wrist(), [table_pose()], [0.05], "table", width=160, height=120)[0]
    with pytest.raises(InputError, match="160 x 120, earlier frames are 320 x 180"):
        slam.process(small)
    assert slam.process(wrist()[1]).verdict == "ok"


def test_the_cameras_have_no_pose_before_the_map_begins_or_while_the_first_camera_is_lost() -> None:
    T_first = CameraConfig(T_first_camera=pose_config(T_FIRST_CARRIED))
    slam = Slam(Config(cameras={"table": CameraConfig(T_world_camera=pose_config(np.eye(4))), "side": T_first}))
    assert slam.process(table_frames()[0]).reasons == ("the map has not begun",)
    slam.process(wrist()[0])
    black = np.zeros_like(wrist()[1].rgb), np.zeros_like(wrist()[1].depth)
    assert slam.process(replace(wrist()[1], rgb=black[0], depth=black[1])).verdict == "lost"
    side = replace(table_frames()[1], camera_name="side", stamp=0.05)
    assert slam.process(side).reasons == ("the first camera is lost, or its motion is unknown",)


def test_a_loop_closure_moves_keyframes_gaussians_results_and_pose_of_a_fixed_camera_together() -> None:
    T = in_world(wrist(), table_pose())
    still = MappingConfig(refine_iterations=0)
    slam = processed(estimated(T @ WRONG, fixed=True), table_frames()[:-1], mapping=still)
    mapper = slam._mapper
    T = slam.trajectory_of("table").T_world_camera[-1]
    anchor = slam.further_cameras["table"].anchor
    assert anchor
    move = se3_exp(np.array([0.02, 0.01, 0.0, 0.0, 0.03, 0.0]))
    before = mapper.model.means[mapper.model.anchors == NUMBERS].numpy().astype(np.float64)
    first = {k.number: k.T_world_camera for k in mapper.first_keyframes}
    mapper.loops.correction = {number: move if number == anchor else np.eye(4) for number in mapper.loops.graph.poses}
    slam.close_loops()
    keyframe = next(k for k in mapper.keyframes if k.camera_name)
    assert np.allclose(keyframe.T_world_camera, move @ T)
    assert np.allclose(keyframe.reference.T_world_camera, move @ T)
    after = mapper.model.means[mapper.model.anchors == NUMBERS].numpy()
    assert np.allclose(after, before @ move[:3, :3].T + move[:3, 3], atol=1e-5)
    assert np.allclose(slam.trajectory_of("table").T_world_camera, move @ T)
    moved = {k.number: k.T_world_camera @ inverse(first[k.number]) for k in mapper.first_keyframes}
    assert np.allclose(moved[anchor], move)
    frame = replace(table_frames()[-1], index=99)
    found = slam.process(frame).T_world_camera
    assert found is not None
    assert np.allclose(found, move @ T)


def test_numbers_and_loops_of_the_first_camera_are_as_without_the_others() -> None:
    slam = processed(CameraConfig(T_world_camera=pose_config(in_world(wrist(), table_pose()))), table_frames())
    own = [k.number for k in slam._mapper.first_keyframes]
    assert own == list(range(len(own)))
    assert set(slam._mapper.loops.graph.poses) == set(own)
    assert set(slam._mapper.loops.adjacency) <= set(own)


def test_a_carried_camera_has_no_pose_where_the_motion_of_the_first_one_is_unknown() -> None:
    slam = Slam(Config(cameras={"side": CameraConfig(T_first_camera=pose_config(T_FIRST_CARRIED))}))
    side = replace(table_frames()[0], camera_name="side")
    slam.process(wrist()[0])
    assert slam.process(replace(side, stamp=wrist()[0].stamp)).verdict == "ok"  # of the same time
    assert slam.process(replace(side, stamp=wrist()[0].stamp + 0.01)).verdict == "lost"  # without a velocity
    slam.process(wrist()[1])
    assert slam.process(replace(side, stamp=wrist()[1].stamp + 0.01)).verdict == "ok"
    assert slam.process(replace(side, stamp=wrist()[1].stamp - 0.01)).verdict == "lost"  # older than the first camera
    assert slam.process(replace(side, stamp=wrist()[1].stamp + 0.5)).verdict == "lost"  # a gap


@pytest.mark.long
def test_a_given_pose_stays_where_a_loop_closure_moves_other_keyframes() -> None:
    T = in_world(wrist(), table_pose())
    for camera in (CameraConfig(T_world_camera=pose_config(T)), estimated(T, fixed=True)):
        slam = processed(camera, table_frames()[:3])
        move = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
        poses = slam._mapper.loops.graph.poses
        slam._mapper.loops.correction = {number: move if number else np.eye(4) for number in poses}
        slam.close_loops()
        found = slam.further_cameras["table"]
        assert isinstance(found, MountedCamera)
        assert np.allclose(found.pose.T_parent_camera, T, atol=1e-9)
        assert np.allclose(slam.trajectory_of("table").T_world_camera, T, atol=1e-9)


def test_a_pose_of_a_free_camera_moves_with_the_keyframe_that_views_the_same_place() -> None:
    poses = [wrist().ground_truth.T_world_camera[0]] * FRAMES  # it stays at the first keyframe
    slam = processed(CameraConfig(), frames_of(wrist(), poses, wrist().stamps, "head", width=240), "head")
    camera = slam.further_cameras["head"]
    assert camera.anchor == 0
    before = slam.trajectory_of("head").T_world_camera
    move = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    numbers = slam._mapper.loops.graph.poses
    slam._mapper.loops.correction = {number: move if number else np.eye(4) for number in numbers}
    slam.close_loops()
    assert np.allclose(slam.trajectory_of("head").T_world_camera, before, atol=1e-9)


def test_a_free_camera_is_confirmed_again_after_the_map_went_back() -> None:
    poses = [wrist().ground_truth.T_world_camera[0]] * FRAMES  # it stays at the first keyframe
    slam = processed(CameraConfig(), frames_of(wrist(), poses, wrist().stamps, "head", width=240), "head")
    assert [r.verdict for r in slam.results if r.camera_name][-1] == "ok"
    rolled_back(slam, 1 + slam.snapshot().map_version)
    assert slam.further_cameras["head"].anchor is None
    stamps = [wrist().stamps[-1] + k / 30 for k in range(1, 5)]
    again = [slam.process(frame) for frame in frames_of(wrist(), poses[:4], stamps, "head", width=240)]
    assert [r.verdict for r in again] == ["lost"] * 3 + ["ok"]


@pytest.mark.long
def test_a_free_camera_that_sees_another_side_is_never_found_though_it_stands_still() -> None:
    for degrees in (120, 150, 180, 210):
        T = side_view(wrist(), np.radians(degrees), 0.0)
        frames = frames_of(wrist(), [T] * FRAMES, wrist().stamps, "head", width=240)
        slam = processed(CameraConfig(), frames, "head")
        found = slam.trajectory_of("head").T_world_camera
        truth = in_world(wrist(), T)
        assert all(pose_distance(truth, pose)[0] < 0.02 for pose in found), degrees
        assert all(pose_distance(truth, k.T_world_camera)[0] < 0.02 for k in slam.keyframes if k.camera_name)


@pytest.mark.long
@pytest.mark.parametrize("exact", [False, True])
def test_a_camera_that_was_bumped_is_noticed_and_estimated_again_unless_its_pose_is_exact(exact: bool) -> None:
    log = wrist_log(70, width=160, height=120)
    bump = se3_exp(np.array([0.04, 0.02, 0.02, 0.0, 0.03, 0.0]))
    poses = [table_pose() if k < 15 else table_pose() @ bump for k in range(70)]
    frames = frames_of(log, poses, [k / 30 + 0.01 for k in range(70)], "table", width=200, height=120)
    T = in_world(log, table_pose())
    given = CameraConfig(T_world_camera=pose_config(T)) if exact else estimated(T, fixed=True)
    slam = Slam(Config(cameras={"table": given}))
    for frame in in_order(log, frames):
        slam.process(frame)
    camera = slam.further_cameras["table"]
    assert isinstance(camera, MountedCamera)
    last = [r for r in slam.results if r.camera_name][-1]
    if exact:
        assert last.verdict == "lost"
        assert "from its pose" in last.reasons[0]
    else:
        assert camera.pose.known
        assert pose_distance(T @ bump, camera.pose.T_parent_camera)[0] < 5e-3
        assert last.verdict == "ok"
