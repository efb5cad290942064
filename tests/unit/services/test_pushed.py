"""Frames that clients push: answered each, bounded, in order, and never left waiting."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.config import CameraConfig, PoseConfig
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.services.problems import BusyError
from splatbot.services.pushed import FirstCameraElsewhereError, PushedFrames, StreamEndedError
from splatbot.slam import FrameResult

AT_REST = PoseConfig(translation=(0.0, 0.0, 0.0), quaternion_wxyz=(1.0, 0.0, 0.0, 0.0))
CAMERAS = {"table": CameraConfig(T_world_camera=AT_REST), "side": CameraConfig(T_first_camera=AT_REST)}


def _frame(stamp: float, width: int = 4, name: str = "") -> Frame:
    camera = Camera(10, 10, 1.5, 1.5, width, 4)
    rgb, depth = np.zeros((4, width, 3), np.uint8), np.ones((4, width), np.float32)
    return Frame(stamp, rgb, depth, camera, camera_name=name)


def test_each_frame_is_answered_by_what_became_of_it() -> None:
    frames = PushedFrames(capacity=10)
    answers = [frames.push(_frame(t)) for t in (1.0, 2.0, 3.0)]
    frames.end()

    def read() -> None:
        for frame in frames:
            frames.answer(FrameResult(frame.index, frame.stamp, np.eye(4), "ok"))

    reader = threading.Thread(target=read)
    reader.start()
    assert [a.result(5).stamp for a in answers] == [1.0, 2.0, 3.0]
    reader.join(5)
    assert not reader.is_alive()


def test_more_frames_than_may_wait_are_refused_and_not_mapped() -> None:
    frames = PushedFrames(capacity=2)
    frames.push(_frame(1.0))
    frames.push(_frame(2.0))
    with pytest.raises(BusyError, match="2 frames wait"):
        frames.push(_frame(3.0))
    frames.answer(FrameResult(0, 1.0, None, "lost"))
    frames.push(_frame(3.0))
    frames.end()
    assert [f.stamp for f in frames] == [1.0, 2.0, 3.0]


def test_a_frame_of_another_size_or_out_of_order_is_refused_alone() -> None:
    frames = PushedFrames()
    frames.push(_frame(1.0))
    with pytest.raises(InputError, match="8 x 4"):
        frames.push(_frame(2.0, width=8))
    with pytest.raises(InputError, match="not after"):
        frames.push(_frame(1.0))
    frames.push(_frame(2.0))


def test_after_the_end_nothing_is_taken_and_nobody_waits_for_ever() -> None:
    frames = PushedFrames()
    answer = frames.push(_frame(1.0))
    frames.abandon("the service stops")
    with pytest.raises(StreamEndedError, match="the service stops"):
        answer.result(5)
    with pytest.raises(StreamEndedError, match="no more frames"):
        frames.push(_frame(2.0))


def test_each_camera_has_its_own_size_and_its_own_order_of_stamps() -> None:
    frames = PushedFrames(10, cameras=CAMERAS)
    frames.push(_frame(1.0))
    frames.push(_frame(0.5, 8, "table"))
    with pytest.raises(InputError, match=r"is not after 0\.5"):
        frames.push(_frame(0.5, 8, "table"))
    with pytest.raises(InputError, match="4 x 4, frames before are 8 x 4"):
        frames.push(_frame(0.6, 4, "table"))
    with pytest.raises(InputError, match=r"is 'shelf'.*table, side"):
        frames.push(_frame(0.6, 8, "shelf"))
    with pytest.raises(InputError, match="further cameras are none"):
        PushedFrames().check_camera("table")
    frames.push(_frame(0.6, 8, "table"))


def test_of_the_frames_that_wait_the_earliest_is_read_first_and_the_end_last() -> None:
    frames = PushedFrames(10, cameras=CAMERAS)
    for stamp, name in ((1.0, ""), (0.5, "table"), (0.9, "side"), (0.7, "table"), (1.2, "")):
        frames.push(_frame(stamp, name=name))
    frames.end()
    assert [(f.stamp, f.camera_name) for f in frames] == [
        (0.5, "table"),
        (0.7, "table"),
        (0.9, "side"),
        (1.0, ""),
        (1.2, ""),
    ]


def test_the_cameras_of_a_map_share_its_places() -> None:
    frames = PushedFrames(2, cameras=CAMERAS)
    frames.push(_frame(1.0))
    frames.push(_frame(1.0, name="table"))
    with pytest.raises(BusyError, match="2 frames wait"):
        frames.push(_frame(1.0, name="side"))


@pytest.mark.parametrize(
    ("stamp", "error"),
    [(4.9, "0.100 s after it"), (4.9979, "after it"), (4.9981, ""), (5.0, ""), (5.0999, ""), (5.1001, "before it")],
)
def test_a_frame_of_a_carried_camera_is_read_near_the_newest_one_of_the_first_camera_alone(
    stamp: float, error: str
) -> None:
    frames = PushedFrames(10, cameras=CAMERAS)
    reader = iter(frames)
    for first in (4.94, 5.0):
        frames.push(_frame(first))
        assert next(reader).stamp == first
    carried, fixed = frames.push(_frame(stamp, name="side")), frames.push(_frame(6.0, name="table"))
    read = next(reader)
    if error:
        with pytest.raises(FirstCameraElsewhereError, match=error):
            carried.result(0)
        assert read.camera_name == "table"
    else:
        assert (read.camera_name, read.stamp) == ("side", stamp)
    assert not fixed.done()


def test_a_carried_camera_waits_for_the_velocity_of_the_first_one_and_follows_it_for_two_of_its_frames() -> None:
    frames = PushedFrames(10, cameras=CAMERAS)
    for stamp, name in ((5.0, ""), (5.001, "side"), (5.01, "side"), (5.02, ""), (5.059, "side"), (5.061, "side")):
        frames.push(_frame(stamp, name=name))
    frames.end()
    read = [f.stamp for f in frames]
    assert read == [5.0, 5.001, 5.02, 5.059]


def test_a_first_frame_that_is_refused_by_the_mask_gives_a_carried_camera_no_pose() -> None:
    def mask(frame: Frame) -> Frame:
        if frame.stamp == 5.0 and not frame.camera_name:
            raise InputError("is refused.")
        return frame

    frames = PushedFrames(10, mask, CAMERAS)
    answers = [frames.push(_frame(t, name=name)) for t, name in ((4.0, ""), (5.0, ""), (5.01, "side"))]
    frames.end()
    assert [f.stamp for f in frames] == [4.0]
    with pytest.raises(FirstCameraElsewhereError, match=r"1\.010 s before"):
        answers[2].result(0)


def test_stamps_of_two_clocks_are_refused_and_after_a_jump_of_their_clock_cameras_keep_their_distance() -> None:
    frames = PushedFrames(10, cameras=CAMERAS)
    frames.push(_frame(1e9))
    with pytest.raises(InputError, match="from the newest frame of the map"):
        frames.push(_frame(5.0, name="table"))
    frames.push(_frame(1e9 + 0.02, name="table"))
    frames.resync()
    frames.push(_frame(50.0))
    frames.push(_frame(50.01, name="table"))
    frames.end()
    stamps = [f.stamp for f in frames]
    assert stamps == sorted(stamps)
    assert stamps[3] - stamps[2] == pytest.approx(0.01, abs=1e-6)
