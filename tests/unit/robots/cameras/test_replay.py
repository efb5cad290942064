"""A recording that behaves as a camera."""

from __future__ import annotations

import threading
import time
from itertools import islice

import numpy as np
import pytest

from splatbot.errors import DeviceError, InputError
from splatbot.logs import open_log
from splatbot.protocols import FrameSource
from splatbot.robots.cameras import ReplayCamera, open_camera, replay
from splatbot.robots.cameras.replay import ReplayOptions
from tests.conftest import MakeLog


@pytest.fixture
def all_buffered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has cameras buffer all frames, so that a busy machine, whose reader is slow, loses none."""
    monkeypatch.setattr(replay, "_QUEUE", 1000)


def test_frames_come_no_earlier_than_their_stamps_say(make_log: MakeLog) -> None:
    camera = open_camera(f"replay:{make_log(4, period=0.1)}?speed=2")
    assert isinstance(camera, FrameSource)
    begun = time.monotonic()
    arrived = [(frame.index, time.monotonic() - begun) for frame in camera]
    assert [index for index, _ in arrived] == [0, 1, 2, 3]
    assert all(at >= 0.05 * index for index, at in arrived)


@pytest.mark.usefixtures("all_buffered")
def test_frames_are_the_recording_s(make_log: MakeLog) -> None:
    log = open_log(make_log())
    for a, b in zip(log, ReplayCamera(log), strict=True):
        assert a.stamp == b.stamp
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)


@pytest.mark.usefixtures("all_buffered")
def test_a_loop_goes_on_with_increasing_stamps(make_log: MakeLog) -> None:
    camera = ReplayCamera(open_log(make_log(3)), ReplayOptions(loop=True))
    stamps = [frame.stamp for frame in islice(camera, 7)]
    np.testing.assert_allclose(np.diff(stamps), 1 / 30, atol=1e-5)


def test_a_slow_reader_loses_the_oldest_frames(make_log: MakeLog) -> None:
    # The second frame waits, so that a busy machine, too, has taken the first one before the others come.
    camera = ReplayCamera(open_log(make_log(20)), ReplayOptions(speed=100, stall=1, stall_s=2.0))
    taken: list[int] = []
    for frame in camera:
        end = time.monotonic() + 60
        while not taken and camera.dropped < 15 and time.monotonic() < end:  # slow to read the first one
            time.sleep(0.01)
        taken.append(frame.index)
    assert taken == [0, 16, 17, 18, 19]
    assert camera.dropped == 15


def test_a_stall_delays_what_follows_and_loses_nothing(make_log: MakeLog) -> None:
    camera = ReplayCamera(open_log(make_log(4)), ReplayOptions(speed=10, stall=2, stall_s=0.3))
    begun = time.monotonic()
    times = [time.monotonic() - begun for _ in camera]
    assert len(times) == 4
    assert times[2] >= 0.3


@pytest.mark.usefixtures("all_buffered")
def test_dropped_and_broken_frames_are_the_same_each_time(make_log: MakeLog) -> None:
    log = open_log(make_log(30))
    options = ReplayOptions(drop=0.3, corrupt=0.3, speed=100)
    played = [list(ReplayCamera(log, options)) for _ in range(2)]
    indices = [[frame.index for frame in frames] for frames in played]
    assert indices[0] == indices[1]
    assert 10 < len(indices[0]) < 30
    broken = [frame.index for frame in played[0] if not (frame.rgb == log[frame.index].rgb).all()]
    assert 0 < len(broken) < len(indices[0])
    frame = next(f for f in played[0] if f.index == broken[0])
    np.testing.assert_array_equal(frame.rgb[:24], log[frame.index].rgb[:24])


def test_a_device_that_is_unplugged_raises_after_the_frames_before(make_log: MakeLog) -> None:
    camera = ReplayCamera(open_log(make_log()), ReplayOptions(unplug=3))
    taken: list[int] = []
    with pytest.raises(DeviceError, match="is gone"):
        taken.extend(frame.index for frame in camera)
    assert taken == [0, 1, 2]


def test_closing_ends_a_wait_for_a_frame(make_log: MakeLog) -> None:
    camera = ReplayCamera(open_log(make_log()), ReplayOptions(stall=1, stall_s=60))
    begun = time.monotonic()
    taken = []
    for frame in camera:
        taken.append(frame.index)
        threading.Timer(0.2, camera.close).start()  # during the wait for the second frame
    assert taken == [0]
    assert time.monotonic() - begun < 30


@pytest.mark.parametrize("query", ["speed=fast", "speed=0", "drop=2", "unplug=x"])
def test_an_option_that_makes_no_sense_is_refused(query: str, make_log: MakeLog) -> None:
    with pytest.raises(InputError, match="replay"):
        open_camera(f"replay:{make_log()}?{query}")


def test_a_camera_of_another_kind_is_refused() -> None:
    with pytest.raises(InputError, match="replay:"):
        open_camera("webcam:0")


def test_the_log_keeps_the_options_that_are_its_own() -> None:
    camera = open_camera("replay:synthetic:tabletop?frames=2&speed=50&width=64&height=48")
    assert [frame.rgb.shape for frame in camera] == [(48, 64, 3)] * 2


def test_a_camera_that_comes_back_goes_on_and_one_unplugged_at_its_last_frame_ends(make_log: MakeLog) -> None:
    log = open_log(make_log(5))
    for unplug, later in ((2, [3, 4]), (4, [])):
        camera = ReplayCamera(log, ReplayOptions(speed=100, unplug=unplug, replug_s=0.05))
        frames = iter(camera)
        with pytest.raises(DeviceError):
            list(frames)
        time.sleep(0.06)
        back = list(camera)
        assert [frame.index for frame in back] == later
        assert [frame.stamp for frame in back] == pytest.approx([log[k].stamp + 0.05 for k in later])
