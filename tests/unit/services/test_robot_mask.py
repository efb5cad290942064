"""The robot's joints at the time of each live image."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.mapping.selfmask import JointsUnknownError, SelfMask
from splatbot.robots.panda import panda
from splatbot.services.robot_mask import JointHistory, MaskedSource, RobotMask
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
    assert 0.1 <= time.monotonic() - begin < 2.0


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
