"""The service masks the robot in recordings of ROS topics by their TF, as `splatbot map --robot` does."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.mapping.selfmask import JointsUnknownError
from splatbot.robots.in_view import open_without_robot
from splatbot.robots.panda import panda
from splatbot.services.mapping import open_rig
from splatbot.services.recordings import allowed_log
from splatbot.services.robot_mask import MaskedSource, RobotMask
from splatbot.sim.wrist import WristLog
from splatbot.workspace import NAME, Workspace
from tests.ros_recording import record_ros
from tests.swept_arm import T_BASE_STATIC_CAMERA, static_log


@pytest.fixture(scope="module")
def log() -> WristLog:
    return static_log(1.0)


@pytest.fixture(scope="module")
def bag(log: WristLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_ros(tmp_path_factory.mktemp("tf") / "bag", log)


def masks(frames: Iterable[Frame]) -> NDArray[np.bool_]:
    return np.array([frame.mask for frame in frames], np.bool_)


def test_frames_of_a_recording_are_masked_as_map_masks_them_and_an_object_in_the_hand_too(bag: Path) -> None:
    recorded = open_log(str(bag))
    mask = RobotMask(panda(), None, log=recorded)
    found, expected = masks(MaskedSource(recorded, mask)), masks(open_without_robot(str(bag), "panda"))
    np.testing.assert_array_equal(found, expected)
    assert 0.01 < 1.0 - np.mean(found) < 0.9
    assert (mask.masked, mask.refused) == (len(recorded), 0)
    mask.hold([[0.0, 0.0, 0.2, 0.15]])
    held = masks(MaskedSource(recorded, mask))
    assert not (held & ~found).any()
    assert (found & ~held).any()


def test_a_frame_whose_transforms_are_stale_is_left_out_and_counted_with_the_reason(
    log: WristLog, tmp_path: Path
) -> None:
    recorded = open_log(str(record_ros(tmp_path / "bag", log, tf_until=0.5)))
    mask = RobotMask(panda(), Workspace(), log=recorded)
    assert [frame.index for frame in MaskedSource(recorded, mask)] == [0, 1, 2]
    assert (mask.masked, mask.refused) == (3, 2)
    assert "TF of panda_link1" in str(mask.problem)
    assert "missing or stale" in str(mask.problem)


def test_a_recording_without_tf_needs_the_place_of_the_camera(log: WristLog) -> None:
    with pytest.raises(InputError, match="T_link_camera"):
        RobotMask(panda(), Workspace(), log=log)


def test_each_camera_of_a_rig_is_masked_by_the_tf_of_its_recording_at_its_own_clock(
    bag: Path, log: WristLog, tmp_path: Path
) -> None:
    record_ros(tmp_path / "other", log)
    cameras = {"first": {"log": str(bag)}, "other": {"log": "other", "time_offset": 0.05}}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump({"cameras": cameras}, sort_keys=False))
    rig, workspaces = open_rig(str(tmp_path / "rig.yaml"))
    mask = RobotMask(panda(), workspaces.pop(""), further=workspaces, log=rig)
    expected = masks(open_without_robot(str(bag), "panda"))
    frames = list(MaskedSource(rig, mask))
    for name in ("", "other"):
        found = masks([frame for frame in frames if frame.camera_name == name])
        np.testing.assert_array_equal(found, expected)
    Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0).save(tmp_path / "other" / NAME)
    with pytest.raises(JointsUnknownError, match="mount of camera other"):
        RobotMask(panda(), None, log=rig)(frames[1])


def test_a_client_may_name_the_file_of_a_recording_under_a_root_and_no_other_file(bag: Path, tmp_path: Path) -> None:
    file = next(bag.glob("*.mcap"))
    assert allowed_log(f"bag/{file.name}", [str(bag.parent)], max_frames=9, max_pixels=99) == str(file)
    (tmp_path / "linked.mcap").symlink_to(file)
    (tmp_path / "notes.txt").write_text("")
    for name in ("linked.mcap", "notes.txt", "missing.mcap", str(file)):
        with pytest.raises(InputError, match="no recording"):
            allowed_log(name, [str(tmp_path)], max_frames=9, max_pixels=99)
