"""The robot is masked at the mount of each camera of a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.geometry import look_at
from splatbot.mapping.selfmask import JointsUnknownError, SelfMask
from splatbot.robots.panda import panda
from splatbot.services.robot_mask import MaskedSource, RobotMask
from splatbot.services.topics import JointState
from splatbot.workspace import Workspace
from tests.swept_arm import T_BASE_STATIC_CAMERA, static_log, sweep

SCENE = Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0)
T_BASE_OTHER = look_at(np.array([1.0, 0.5, 0.8]), np.array([0.4, 0.0, 0.15]))
OTHER = Workspace(T_link_camera=T_BASE_OTHER, camera_link=0)


def test_each_camera_has_the_mask_of_its_own_mount_by_joints_of_the_frame_and_by_joint_states() -> None:
    frame = static_log(1.0)[2]
    assert frame.joints is not None
    mask = RobotMask(panda(), SCENE, further={"table": OTHER})
    for t in frame.stamp + np.arange(-3, 4) * 0.02:
        mask.history.add(JointState(t, panda().chain.names, sweep(np.array([t]))[0]))
    masks = []
    for name, T in (("", T_BASE_STATIC_CAMERA), ("table", T_BASE_OTHER)):
        expected = SelfMask(panda(), T, link=0).usable(frame)
        own, live = (
            mask(replace(frame, camera_name=name)).mask,
            mask(replace(frame, joints=None, camera_name=name)).mask,
        )
        assert own is not None
        assert live is not None
        np.testing.assert_array_equal(own, expected)
        assert (live != expected).mean() < 2e-3
        masks.append(own)
    assert (masks[0] != masks[1]).mean() > 0.02


def test_an_object_in_the_hand_is_masked_in_the_frames_of_every_camera() -> None:
    frame = static_log(1.0)[2]
    mask = RobotMask(panda(), SCENE, further={"table": OTHER})
    before = {name: mask(replace(frame, camera_name=name)).mask for name in ("", "table")}
    mask.hold([[0.0, 0.0, 0.2, 0.15]])
    for name, empty in before.items():
        held = mask(replace(frame, camera_name=name)).mask
        assert held is not None
        assert empty is not None
        assert (empty & ~held).any()


def test_a_camera_without_a_mount_is_left_out_with_its_reason_and_the_others_go_on() -> None:
    frames = [replace(frame, camera_name="shelf" if frame.index == 2 else "") for frame in static_log(1.0)]
    mask = RobotMask(panda(), SCENE, further={"table": OTHER})
    assert [frame.index for frame in MaskedSource(frames, mask)] == [0, 1, 3, 4]
    assert (mask.masked, mask.refused, mask.problem) == (4, 1, None)
    assert set(mask.problems) == {"shelf"}
    assert "mount of camera shelf" in mask.problems["shelf"]
    with pytest.raises(JointsUnknownError, match="panda cannot be masked"):
        mask(replace(frames[0], camera_name="shelf", joints=None))


def test_a_further_camera_whose_workspace_has_no_mount_is_refused_at_once() -> None:
    with pytest.raises(InputError, match="T_link_camera"):
        RobotMask(panda(), SCENE, further={"table": Workspace()})
