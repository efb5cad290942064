"""An arm that moves between colour and depth is left out at the times of both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.geometry import transform_points
from splatbot.logs import open_log
from splatbot.logs.calibration import Calibration, save_calibration
from splatbot.logs.mcap import record_mcap
from splatbot.logs.ros_frames import camera_info_message, image_message, joint_state_message
from splatbot.logs.ros_types import to_cdr
from splatbot.logs.scenes.tabletop import tabletop
from splatbot.mapping.selfmask import JointsUnknownError, SelfMask
from splatbot.robots.in_view import open_without_robot
from splatbot.robots.panda import panda
from splatbot.run.masked import MaskedLog
from splatbot.services.robot_mask import MaskedSource, RobotMask
from splatbot.services.topics import JointState
from splatbot.sim.wrist import WristLog
from splatbot.slam import Slam
from splatbot.workspace import NAME, Workspace
from tests.swept_arm import T_BASE_STATIC_CAMERA, T_SCENE_BASE, distance_to_arm, near_the_sweep

DELAY = 0.1  # [s] of depth
STRETCHED = np.array([0.0, 0.5, 0.0, -0.8, 0.0, 1.4, 0.785])
SPEED = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # [rad/s]
PAIRS = ((0, 1), (3, 4), (6, 7))  # images of colour and depth, of 10 Hz
SCENE = Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0)
NAMES = panda().chain.names


def joints_at(stamp: float) -> np.ndarray:
    return np.asarray(STRETCHED + (stamp - 0.9) * SPEED)


@pytest.fixture(scope="module")
def log() -> WristLog:
    """Images of 10 Hz of an arm that turns by 1 rad/s before a static camera."""
    joints = np.array([joints_at(k / 10) for k in range(8)])
    surfaces = tabletop().surfaces
    return WristLog(
        panda(), joints, surfaces, T_scene_base=T_SCENE_BASE, T_link_camera=T_BASE_STATIC_CAMERA, link=0, width=160,
        rate=10.0,
    )  # fmt: skip


def write_tum(folder: Path, log: WristLog, until: float = 0.9) -> str:
    """Write a TUM folder whose depth is 0.1 s later than colour, with joints of 20 Hz until a time [s]."""
    lines: dict[str, list[str]] = {"rgb": [], "depth": []}
    for kind, at, images in (("rgb", 0, PAIRS), ("depth", 1, PAIRS)):
        (folder / kind).mkdir(parents=True)
        for pair in images:
            frame = log[pair[at]]
            image = frame.rgb[..., ::-1] if kind == "rgb" else np.rint(frame.depth * 5000).astype(np.uint16)
            cv2.imwrite(str(folder / kind / f"{pair[at]}.png"), image)
            lines[kind].append(f"{pair[at] / 10:.3f} {kind}/{pair[at]}.png")
        (folder / f"{kind}.txt").write_text("\n".join(lines[kind]))
    save_calibration(Calibration(log.camera, 5000.0), folder / "intrinsics.json")
    stamps = np.arange(-0.1, until, 0.05)
    (folder / "joints.txt").write_text("\n".join(" ".join(map(str, [t, *joints_at(t)])) for t in stamps.tolist()))
    SCENE.save(folder / NAME)
    return f"{folder}?pair_within=0.11"


def write_ros(folder: Path, log: WristLog, until: float = 0.9) -> str:
    """Write the same as ROS topics by rosbags; a gripper has joint states of its own, which end early."""
    store, opened = get_typestore(Stores.ROS2_JAZZY), {}
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as out:

        def write(topic: str, message: object, stamp: float) -> None:
            kind = str(message.__msgtype__)  # type: ignore[attr-defined]
            if topic not in opened:
                opened[topic] = out.add_connection(topic, kind, typestore=store)
            out.write(opened[topic], round((stamp + 1) * 1e9), to_cdr(message))

        for t in np.arange(-0.1, until, 0.05).tolist():
            write("/joint_states", joint_state_message(t + 1, joints_at(t), NAMES), t)
            if t < 0.62:
                write("/joint_states", joint_state_message(t + 1, [0.04], ("finger",)), t)
        for color, depth in PAIRS:
            write("/cam/color/camera_info", camera_info_message(color / 10 + 1, log.camera), color / 10)
            write("/cam/color/image_raw", image_message(color / 10 + 1, log[color].rgb), color / 10)
            write("/cam/depth/image_raw", image_message(depth / 10 + 1, log[depth].depth), depth / 10)
    SCENE.save(folder / NAME)
    return f"{folder}?pair_within=0.11"


def write_recorded(folder: Path, log: WristLog, until: float = 0.9) -> str:
    """Write an MCAP file of the folder as `splatbot record` does, which has no joint states but those of the frames."""
    source = open_log(write_tum(folder, log, until))
    SCENE.save(folder / "file" / NAME)
    return f"{record_mcap(source, folder / 'file' / 'a.mcap')}?pair_within=0.11"


def check(frames: list[Frame], log: WristLog) -> None:
    """Check that neither image shows the arm in a usable pixel, and that colour's time alone is not enough."""
    alone = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    assert len(frames) == len(PAIRS)
    left = 0
    for frame, (color, depth) in zip(frames, PAIRS, strict=True):
        assert frame.depth_delay == pytest.approx(DELAY, abs=1e-6)
        assert frame.mask is not None
        shown = log.shows_robot(color) | log.shows_robot(depth)
        assert not (frame.mask & shown).any()
        assert 0.4 < frame.mask.mean() < 0.95
        usable = frame.mask & (frame.depth > 0)
        points = transform_points(
            T_BASE_STATIC_CAMERA, frame.camera.backproject(frame.depth)[usable][::5].astype(float)
        )
        assert distance_to_arm(points, log.joints[depth]).min() > 0.015
        left += int((alone.usable(replace(frame, mask=None)) & log.shows_robot(depth)).sum())
    assert left > 150


@pytest.mark.parametrize("write", [write_tum, write_ros, write_recorded], ids=["TUM", "ROS", "recorded"])
def test_no_pixel_of_a_recording_shows_the_arm_at_the_time_of_colour_or_of_depth(
    log: WristLog, tmp_path: Path, write: Callable[[Path, WristLog], str]
) -> None:
    path = write(tmp_path / "log", log)
    check(list(open_without_robot(path, "panda")), log)
    served = open_log(path)
    check(list(MaskedSource(served, RobotMask(panda(), SCENE, log=served))), log)


@pytest.mark.parametrize("write", [write_tum, write_ros], ids=["TUM", "ROS"])
def test_a_frame_whose_arm_is_not_known_at_the_time_of_depth_is_refused(
    log: WristLog, tmp_path: Path, write: Callable[[Path, WristLog, float], str]
) -> None:
    found = open_without_robot(write(tmp_path / "log", log, 0.62), "panda")
    assert found[1].mask is not None
    with pytest.raises(LogError, match=r"has no joint.* at the time of depth"):
        found[2]


def pushed(log: WristLog) -> Frame:
    """Return a frame with joints at the time of colour alone."""
    return replace(log[3], depth=log[4].depth, depth_delay=DELAY)


def test_a_live_frame_is_masked_at_both_times_by_its_own_joints_or_by_joint_states(log: WristLog) -> None:
    own = RobotMask(panda(), SCENE)(replace(pushed(log), depth_joints=log.joints[4]))
    mask = RobotMask(panda(), SCENE)
    with pytest.raises(JointsUnknownError, match=r"missing or stale.*give depth_joints"):
        mask(pushed(log))
    for t in np.arange(0.0, 1.0, 0.02).tolist():
        mask.history.add(JointState(t, NAMES, joints_at(t)))
    by_states = mask(pushed(log)).mask
    assert own.mask is not None
    assert by_states is not None
    assert (own.mask != by_states).mean() < 1e-3
    assert not (own.mask & (log.shows_robot(3) | log.shows_robot(4))).any()


def test_joints_at_the_time_of_depth_are_as_many_as_those_of_colour(log: WristLog) -> None:
    with pytest.raises(InputError, match="depth_joints: has 6 positions"):
        replace(pushed(log), depth_joints=np.zeros(6))


@pytest.mark.long
def test_no_gaussian_is_on_the_moving_arm_and_many_are_if_it_is_masked_at_the_time_of_colour_alone(
    log: WristLog, tmp_path: Path
) -> None:
    alone = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    source = open_log(write_tum(tmp_path / "log", log))
    at_depth = log.joints[[depth for _, depth in PAIRS]]

    def old(frame: Frame) -> Frame:
        return replace(frame, mask=alone.usable(frame))

    counts = []
    for masked in (MaskedLog(source, alone), MaskedLog(source, old)):
        slam = Slam()
        for frame in masked:
            slam.process(frame)
        slam.finish()
        counts.append(near_the_sweep(slam.snapshot().model.means.numpy(), T_BASE_STATIC_CAMERA, at_depth))
    assert counts[0] == 0
    assert counts[1] > 10
