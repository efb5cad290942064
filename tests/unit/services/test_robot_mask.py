"""The robot's joints at the time of each live image."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import inverse, rotation_to_quat
from splatbot.logs.ros_frames import RosFrame
from splatbot.logs.ros_transforms import StampedTransform
from splatbot.logs.ros_types import build
from splatbot.mapping.selfmask import JointsUnknownError, SelfMask
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.robots.store import load_robot
from splatbot.services.robot_mask import JointHistory, MaskedSource, RobotMask
from splatbot.services.ros.moveit_types import ATTACHED_TYPE, register_moveit_types
from splatbot.services.ros.robot_topics import RobotTopics
from splatbot.services.topics import JointState
from splatbot.workspace import Workspace
from tests.swept_arm import T_BASE_STATIC_CAMERA, static_log, sweep

SCENE = Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0)
NAMES = ("a", "b")


def history(*stamps: float) -> JointHistory:
    known = JointHistory(NAMES)
    for stamp in stamps:
        known.add(JointState(stamp, NAMES, np.array([stamp, -stamp])))
    return known


def test_joints_are_interpolated_between_the_states_around_an_image() -> None:
    np.testing.assert_allclose(history(1.0, 1.05, 1.1).at(1.02, 0.0), [1.02, -1.02], atol=1e-12)
    np.testing.assert_allclose(history(1.1, 1.0, 1.05).at(1.08, 0.0), [1.08, -1.08], atol=1e-12)  # out of order
    np.testing.assert_allclose(history(1.0).at(1.0, 0.0), [1.0, -1.0])


@pytest.mark.parametrize(
    ("stamps", "image"),
    [((), 1.0), ((1.0,), 1.01), ((1.0,), 0.99), ((1.0, 1.5), 1.25), ((1.0, 1.11), 1.005), ((1e9,), 1.0)],
    ids=["none", "none after", "none before", "far apart", "next too late", "another clock"],
)
def test_joints_that_are_missing_or_stale_are_refused(stamps: tuple[float, ...], image: float) -> None:
    with pytest.raises(JointsUnknownError, match="missing or stale"):
        history(*stamps).at(image, 0.0)


def test_a_state_after_the_image_is_waited_for_and_no_longer_than_given() -> None:
    known = history(1.0)
    threading.Timer(0.05, lambda: known.add(JointState(1.05, NAMES, np.array([1.05, -1.05])))).start()
    np.testing.assert_allclose(known.at(1.03, 5.0), [1.03, -1.03], atol=1e-12)
    begin = time.monotonic()
    with pytest.raises(JointsUnknownError):
        known.at(1.07, 0.1)
    assert 0.1 <= time.monotonic() - begin < 30.0


def test_states_of_a_gripper_are_left_out_and_broken_ones_are_refused() -> None:
    known = history(1.0)
    assert not known.add(JointState(1.05, ("finger",), np.array([0.02])))
    assert known.add(JointState(1.05, ("finger", "b", "a"), np.array([0.02, -1.05, 1.05])))
    np.testing.assert_allclose(known.at(1.05, 0.0), [1.05, -1.05])
    assert not known.add(JointState(1.05, ("joint_0", "joint_1"), np.array([9.0, 9.0])))  # of a hand
    assert not known.add(JointState(1.05, (), np.array([9.0, 9.0])))
    np.testing.assert_allclose(known.at(1.05, 0.0), [1.05, -1.05])
    with pytest.raises(InputError, match="no joint b"):
        known.add(JointState(1.1, ("a",), np.array([1.0])))
    with pytest.raises(InputError, match="not finite"):
        known.add(JointState(1.1, NAMES, np.array([1.0, np.nan])))
    with pytest.raises(InputError, match="not finite"):
        known.add(JointState(np.inf, NAMES, np.array([1.0, 1.0])))


def test_a_clock_that_was_set_back_starts_over_and_memory_is_bounded() -> None:
    back = history(100.0, 100.05)
    back.add(JointState(95.0, NAMES, np.array([-1.0, 1.0])))  # by 5 s
    with pytest.raises(JointsUnknownError):
        back.at(100.02, 0.0)
    assert back.at(95.0, 0.0)[0] == -1.0
    back.clear()
    with pytest.raises(JointsUnknownError, match="no joint state"):
        back.at(95.0, 0.0)
    known = history(1e9, 1e9 + 0.01)
    for k in range(30_000):
        known.add(JointState(5.0 + k * 1e-4, NAMES, np.array([k, 0.0])))
    assert known.at(7.9, 0.0)[0] == pytest.approx(29_000, abs=1e-3)
    assert len(known._stamps) == 20_000
    with pytest.raises(JointsUnknownError):
        known.at(1e9, 0.0)


def test_a_frame_gets_the_mask_of_its_own_time_whatever_the_delay_of_the_states() -> None:
    log = static_log(2.0)
    plain = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    times = np.arange(0.0, 2.5, 0.02)
    for delay in (0.0, 0.1, -0.05):
        mask = RobotMask(panda(), replace(SCENE, joint_delay=delay))
        for t in times:
            mask.history.add(JointState(t + delay, panda().chain.names, sweep(np.array([t]))[0]))
        frame = log[4]
        live = mask(replace(frame, joints=None))
        assert live.mask is not None
        assert (live.mask != plain.usable(frame)).mean() < 2e-3  # of the interpolation between states
        assert (mask.masked, mask.refused, mask.problem) == (1, 0, None)


def test_frames_without_known_joints_are_left_out_counted_and_reported(caplog: pytest.LogCaptureFixture) -> None:
    log = static_log(2.0)
    mask = RobotMask(panda(), SCENE)
    frames = [frame if frame.index % 2 else replace(frame, joints=None) for frame in log]
    kept = list(MaskedSource(frames, mask))
    assert [frame.index for frame in kept] == [1, 3, 5, 7, 9]
    assert all(frame.mask is not None for frame in kept)
    assert (mask.masked, mask.refused) == (5, 5)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "robot in them cannot be masked" in caplog.text


def test_the_arm_is_masked_at_the_time_of_depth_too() -> None:
    log = static_log(2.0)
    plain = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    mask = RobotMask(panda(), SCENE)
    for t in np.arange(0.0, 2.5, 0.02):
        mask.history.add(JointState(t, panda().chain.names, sweep(np.array([t]))[0]))
    frame, later = log[2], 0.4
    live = mask(replace(frame, joints=None, depth_delay=later))
    both = plain.usable(frame) & plain.usable(replace(frame, joints=sweep(np.array([frame.stamp + later]))[0]))
    assert live.mask is not None
    assert (live.mask != both).mean() < 2e-3
    assert (both != plain.usable(frame)).mean() > 2e-3


def test_a_recording_is_not_masked_by_live_states_and_ends_when_it_is_closed() -> None:
    log = static_log(2.0)
    mask = RobotMask(panda(), SCENE)
    for t in np.arange(-1.0, 2.5, 0.02):
        mask.history.add(JointState(t, panda().chain.names, sweep(np.array([t]))[0]))
    recorded = [replace(frame, joints=None) for frame in log]
    assert list(MaskedSource(recorded, mask)) == []
    assert mask.refused == len(log)
    source = MaskedSource(log, mask)
    assert next(iter(source)).index == 0
    source.close()
    assert list(source) == []


def test_a_camera_whose_place_is_unknown_is_refused_at_once() -> None:
    with pytest.raises(InputError, match="T_link_camera"):
        RobotMask(panda(), Workspace())
    with pytest.raises(InputError, match="spheres"):
        RobotMask(panda(), SCENE).hold(np.ones((65, 4)))
    with pytest.raises(InputError, match="radius"):
        RobotMask(panda(), SCENE).hold([[0.0, 0.0, 0.1, -1.0]])


register_moveit_types()
LINKS = tuple(f"panda_link{k}" for k in range(8))


def stamped(parent: str, child: str, stamp: float, T: Array, *, static: bool = False) -> StampedTransform:
    return StampedTransform(parent, child, stamp, T[:3, 3].tolist(), rotation_to_quat(T[:3, :3]).tolist(), static)


def publish_arm(topics: RobotTopics, stamps: Array, *, delay: float = 0.0, prefix: str = "") -> None:
    """Add the transforms of the sweeping arm, each link in the one before it, as its driver publishes them."""
    for t, q in zip(stamps, sweep(stamps), strict=True):
        T = panda().fk(q)
        topics.transforms.add(
            stamped(prefix + LINKS[k], prefix + LINKS[k + 1], t + delay, inverse(T[k]) @ T[k + 1]) for k in range(7)
        )


def with_camera(topics: RobotTopics, base: str = "panda_link0") -> None:
    """Add the camera in the frame of a table, which the base stands on."""
    T_table_base = np.eye(4)
    T_table_base[:3, 3] = 0.3, -0.2, 0.1
    topics.transforms.add(
        [
            stamped("table", base, 0.0, T_table_base, static=True),
            stamped("table", "optical", 0.0, T_table_base @ T_BASE_STATIC_CAMERA, static=True),
        ]
    )


def from_ros(frame: Frame, camera_frame: str = "optical") -> RosFrame:
    return RosFrame(frame.stamp, frame.rgb, frame.depth, frame.camera, frame.index, camera_frame=camera_frame)


@pytest.mark.parametrize("delay", [0.0, 0.3])
@pytest.mark.parametrize("prefix", ["", "left_"])
def test_a_frame_is_masked_by_tf_alone_with_delay_and_prefix(delay: float, prefix: str) -> None:
    log, topics = static_log(2.0), RobotTopics()
    mask = RobotMask(panda(), Workspace(joint_delay=delay, tf_prefix=prefix), topics, camera_in_tf=True)
    publish_arm(topics, np.arange(0.0, 2.5, 0.02), delay=delay, prefix=prefix)
    with_camera(topics, f"{prefix}panda_link0")
    found, expected = mask(from_ros(log[4])), SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0).usable(log[4])
    assert found.mask is not None
    assert (found.mask != expected).mean() < 2e-3
    assert 0.01 < 1.0 - expected.mean() < 0.9
    assert (mask.masked, mask.refused, mask.problem) == (1, 0, None)


def test_a_known_place_of_the_camera_needs_no_frame_of_it_and_depth_is_masked_at_its_own_time() -> None:
    log, topics = static_log(2.0), RobotTopics()
    mask = RobotMask(panda(), SCENE, topics)
    publish_arm(topics, np.arange(0.0, 2.5, 0.02))
    plain = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    live = mask(replace(log[2], joints=None, depth_delay=0.4))
    later = replace(log[2], joints=sweep(np.array([log[2].stamp + 0.4]))[0])
    assert live.mask is not None
    assert (live.mask != (plain.usable(log[2]) & plain.usable(later))).mean() < 2e-3


def test_joint_states_count_where_they_come_and_tf_where_they_have_stopped() -> None:
    log, topics = static_log(2.0), RobotTopics()
    mask = RobotMask(panda(), SCENE, topics)
    publish_arm(topics, np.arange(-0.1, 2.5, 0.02))
    still = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0).usable(replace(log[0], joints=sweep(np.array([0.0]))[0]))
    for t in np.arange(-0.1, 1.1, 0.02):  # of an arm at rest
        mask.history.add(JointState(t, panda().chain.names, sweep(np.array([0.0]))[0]))
    by_joints = mask(replace(log[4], depth=log[0].depth, joints=None))
    assert by_joints.mask is not None
    np.testing.assert_array_equal(by_joints.mask, still)
    by_tf = mask(replace(log[8], joints=None))
    assert by_tf.mask is not None
    plain = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    assert (by_tf.mask != plain.usable(log[8])).mean() < 2e-3


def test_joint_states_that_first_come_during_the_wait_for_tf_count(monkeypatch: pytest.MonkeyPatch) -> None:
    log, topics = static_log(2.0), RobotTopics()
    with_camera(topics)  # TF of the camera alone: the links have none
    mask = RobotMask(panda(), SCENE, topics)
    wait_for_tf = mask._link_poses.mask

    def meanwhile(*given: Any) -> Frame:
        for t in log[2].stamp + np.arange(-3, 4) * 0.02:
            mask.history.add(JointState(t, panda().chain.names, sweep(np.array([t]))[0]))
        return wait_for_tf(*given)

    monkeypatch.setattr(mask._link_poses, "mask", meanwhile)
    found = mask(replace(log[2], joints=None)).mask
    assert found is not None
    assert (found != SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0).usable(log[2])).mean() < 2e-3
    assert (mask.masked, mask.refused, mask.problem) == (1, 0, None)


def test_a_frame_is_refused_where_tf_is_missing_stale_or_not_connected() -> None:
    log, topics = static_log(2.0), RobotTopics()
    mask = RobotMask(panda(), None, topics, camera_in_tf=True)

    def refused(match: str, camera_frame: str = "optical") -> None:
        before = mask.refused
        with pytest.raises(JointsUnknownError, match=match):
            mask(from_ros(log[2], camera_frame))
        assert mask.refused == before + 1
        assert mask.problem is not None

    refused("no frame optical, panda_link0")
    publish_arm(topics, np.arange(0.0, 0.3, 0.02))
    refused("no frame optical")
    with_camera(topics, "another")
    refused("does not connect panda_link0, .* with optical")
    with_camera(topics)
    refused("TF of panda_link1 at 0.400 s is missing or stale")
    publish_arm(topics, np.arange(0.3, 0.5, 0.02))
    refused("name no frame", "")
    assert mask(from_ros(log[2])).mask is not None
    assert (mask.masked, mask.problem) == (1, None)


def test_links_that_do_not_fit_the_model_are_refused() -> None:
    log, topics = static_log(2.0), RobotTopics()
    mask = RobotMask(panda(), None, topics, camera_in_tf=True)
    publish_arm(topics, np.arange(0.0, 1.0, 0.02))
    with_camera(topics)
    longer = np.eye(4)
    longer[1, 3] = 0.1
    topics.transforms.add([stamped("panda_link3", "panda_link4", 0.0, longer, static=True)])
    with pytest.raises(JointsUnknownError, match=r"panda_link4 in TF is .* from the model of panda"):
        mask(from_ros(log[2]))
    nameless = replace(load_robot("panda"), name="mine", link_frames=None)
    with pytest.raises(JointsUnknownError, match="TF cannot mask mine") as raised:
        RobotMask(nameless, None, topics, camera_in_tf=True)(from_ros(log[2]))
    assert "splatbot robot add" in str(raised.value.hint)


def attach(topics: RobotTopics, link: str, *, name: str = "box", size: float = 0.3, operation: int = 0) -> None:
    solid = {"type": 1, "dimensions": [size] * 3}
    values = {"id": name, "operation": operation, "primitives": [solid], "primitive_poses": [{"position": {"z": 0.2}}]}
    topics.attached.take_object(build(ATTACHED_TYPE, link_name=link, object=values))


def test_attached_objects_are_masked_on_the_link_that_carries_them_until_they_are_removed() -> None:
    log, topics = static_log(2.0), RobotTopics()
    mask, plain = RobotMask(panda(), SCENE, topics), SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
    bare = plain.usable(log[2])
    below = np.eye(4)
    below[2, 3] = 0.107
    attach(topics, "panda_hand")
    with pytest.raises(JointsUnknownError, match="link panda_hand of attached 'box' is not known"):
        mask(log[2])
    topics.transforms.add([stamped("panda_link7", "panda_hand", 0.0, below, static=True)])
    found = mask(log[2]).mask
    whole = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0, held=[[0.0, 0.0, 0.307, 0.15]]).usable(log[2])
    assert found is not None
    assert not (found & ~whole).any()  # the sphere in the box is masked
    assert (bare & ~found).mean() > 0.005
    attach(topics, "panda_hand", operation=1)
    released = mask(log[2]).mask
    assert released is not None
    np.testing.assert_array_equal(released, bare)
    topics.transforms.add([stamped("panda_link4", "sensor", 0.0, below, static=True)])
    attach(topics, "sensor")
    assert mask(log[2]).mask is not None


def test_what_a_client_holds_and_what_is_attached_are_masked_together_within_one_number() -> None:
    log, topics = static_log(2.0), RobotTopics()
    mask = RobotMask(panda(), SCENE, topics)
    attach(topics, "panda_link7")
    boxed = mask(log[2]).mask
    mask.hold([[0.0, 0.0, 0.0, 0.3]] * 60)
    both = mask(log[2]).mask
    assert boxed is not None
    assert both is not None
    assert not (both & ~boxed).all()
    for k in range(4):
        attach(topics, "panda_link7", name=f"box{k}")
    with pytest.raises(JointsUnknownError, match="5 attached shapes are too many"):
        mask(log[2])
    mask.hold([])
    assert mask(log[2]).mask is not None
