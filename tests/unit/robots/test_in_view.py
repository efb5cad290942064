"""Recordings of ROS topics with the robot masked by TF; rosbags writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.logs import Log, open_log
from splatbot.mapping.selfmask import SelfMask
from splatbot.robots import in_view
from splatbot.robots.in_view import open_without_robot
from splatbot.robots.panda import panda
from splatbot.sim.wrist import WristLog
from splatbot.workspace import NAME, Workspace
from tests.ros_recording import record_ros
from tests.swept_arm import T_BASE_STATIC_CAMERA, static_log


@pytest.fixture(scope="module")
def log() -> WristLog:
    return static_log(1.2)


def check_masked(found: Log, log: WristLog) -> None:
    plain = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    for a, b in zip(found, log, strict=True):
        expected = plain.usable(b)
        assert a.mask is not None
        assert (a.mask != expected).mean() < 2e-3
        assert 0.01 < 1.0 - expected.mean() < 0.9


def test_a_recording_without_joint_states_and_scene_is_masked_by_its_tf(log: WristLog, tmp_path: Path) -> None:
    path = record_ros(tmp_path / "bag", log)
    check_masked(open_without_robot(str(path), "panda"), log)


def test_delay_and_prefix_of_the_scene_count_in_tf(log: WristLog, tmp_path: Path) -> None:
    path = record_ros(tmp_path / "bag", log, prefix="left_", late=0.3)
    with pytest.raises(LogError, match="TF has no frame panda_link0") as raised:
        open_without_robot(str(path), "panda")[0]
    assert "tf_prefix" in str(raised.value.hint)
    Workspace(tf_prefix="left_", joint_delay=0.3).save(path / NAME)
    check_masked(open_without_robot(str(path), "panda"), log)


def test_joint_offsets_of_the_scene_move_the_links_of_tf_to_the_true_positions(log: WristLog, tmp_path: Path) -> None:
    path = record_ros(tmp_path / "bag", log, joints_until=-1.0)
    offsets = np.array([0.1, 0.06, -0.05, 0.08, 0.02, -0.06, 0.0])
    scene = Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0, joint_offsets=offsets, offsets_of="panda")
    scene.save(path / NAME)
    plain = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    for masked, recorded, made in zip(open_without_robot(str(path), "panda"), open_log(str(path)), log, strict=True):
        assert masked.joints is None
        assert made.joints is not None
        expected, reported = (
            plain.at_poses(recorded, panda().fk(q)).mask for q in (made.joints + offsets, made.joints)
        )
        assert masked.mask is not None
        assert (masked.mask != expected).mean() < 1e-3
        assert (masked.mask != reported).mean() > 1e-2


def test_joint_states_count_where_there_are_any_and_tf_elsewhere(log: WristLog, tmp_path: Path) -> None:
    path = record_ros(tmp_path / "bag", log, joints_until=0.5)
    Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0).save(path / NAME)
    found = open_without_robot(str(path), "panda")
    check_masked(found, log)
    assert found[0].joints is not None
    assert found[4].joints is None


def test_a_frame_at_whose_time_nothing_is_known_is_refused_with_the_reason(log: WristLog, tmp_path: Path) -> None:
    path = record_ros(tmp_path / "bag", log, tf_until=0.5)
    found = open_without_robot(str(path), "panda")
    assert found[1].mask is not None
    with pytest.raises(LogError, match=r"TF of panda_link1 at .* is missing or stale"):
        found[4]


def test_a_recording_with_too_many_transforms_is_refused(
    log: WristLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = record_ros(tmp_path / "bag", log)
    monkeypatch.setattr(in_view, "MAX_RECORDED", 100)
    with pytest.raises(LogError, match="more than 100 transforms"):
        open_without_robot(str(path), "panda")[0]
