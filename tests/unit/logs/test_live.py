"""A camera that is recorded while it is read."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from splatbot.errors import DeviceError, LogError
from splatbot.frame import Frame
from splatbot.logs import live, open_log
from splatbot.logs.live import RecordedCamera
from splatbot.robots.cameras import ReplayCamera
from splatbot.robots.cameras.replay import ReplayOptions
from tests.conftest import MakeLog
from tests.waiting import until


class GivenFrames:
    """A camera that delivers given frames at once."""

    name, uri, dropped = "given", "given://", 0

    def __init__(self, frames: list[Frame]) -> None:
        self._frames = frames

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)

    def close(self) -> None:
        pass


def test_a_slow_reader_misses_frames_but_the_recording_has_all(
    make_log: MakeLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatbot.robots.cameras.replay._QUEUE", 12)  # else a busy machine records late, and loses some
    source = open_log(make_log(12, period=0.05))
    recorded = RecordedCamera(ReplayCamera(source), tmp_path / "a.mcap")
    numbers = []
    for number, frame in recorded.arrivals():
        np.testing.assert_array_equal(frame.depth, source[number].depth)
        numbers.append(number)
        time.sleep(0.12)
    assert numbers == sorted(set(numbers))
    assert len(numbers) < 12
    assert numbers[-1] == 11
    assert len(recorded) == 12
    for k, (own, read) in enumerate(zip(source, open_log(tmp_path / "a.mcap"), strict=True)):
        for frame in (recorded[k], read):
            np.testing.assert_array_equal(frame.rgb, own.rgb)
            np.testing.assert_array_equal(frame.depth, own.depth)
            assert frame.stamp == pytest.approx(own.stamp, abs=1e-9)


def test_frames_of_any_delay_between_colour_and_depth_keep_their_numbers(make_log: MakeLog, tmp_path: Path) -> None:
    source = list(open_log(make_log(5, period=0.1)))
    for name, delays in (("late", [0.08] * 5), ("early", [-0.07] * 5), ("repeated", [0.0, 0.02, -0.08, 0.0, 0.0])):
        frames = [replace(frame, depth_delay=delay) for frame, delay in zip(source, delays, strict=True)]
        recorded = RecordedCamera(GivenFrames(frames), tmp_path / f"{name}.mcap")
        list(recorded.arrivals())
        for log in (recorded, open_log(tmp_path / f"{name}.mcap")):
            assert [frame.depth_delay for frame in log] == pytest.approx(delays, abs=1e-8)
            for k, frame in enumerate(log):
                np.testing.assert_array_equal(frame.depth, source[k].depth)


def test_a_recording_has_the_joints_of_both_times_of_the_live_frames_also_of_a_fast_motion(
    make_log: MakeLog, tmp_path: Path
) -> None:
    def at(stamp: float) -> np.ndarray:
        return np.array([np.sin(90 * stamp), np.cos(70 * stamp)])

    delays = [0.03, -0.02, 0.06, 0.0, 0.013]  # one depth image is later than the next image of colour
    frames = [
        replace(
            frame,
            depth_delay=delay,
            joints=at(frame.stamp),
            joint_names=("a", "b"),
            depth_joints=at(frame.stamp + delay) if delay else None,
        )
        for frame, delay in zip(open_log(make_log(5, period=0.05)), delays, strict=True)
    ]
    known_a = np.array([1.0, np.nan])  # b is not known at the time of depth
    frames[4] = replace(frames[4], depth_joints=at(frames[4].stamp + delays[4]) * known_a)
    recorded = RecordedCamera(GivenFrames(frames), tmp_path / "a.mcap")
    recorded.close()
    for frame, read in zip(frames, open_log(tmp_path / "a.mcap"), strict=True):
        assert read.joint_names == ("a", "b")
        np.testing.assert_array_equal(read.joints, frame.joints)
        if frame.depth_joints is None:
            assert read.depth_joints is None
            continue
        assert read.depth_joints is not None
        known = np.isfinite(frame.depth_joints)
        np.testing.assert_allclose(read.depth_joints[known], frame.depth_joints[known], atol=1e-12)


def test_frames_have_the_numbers_and_stamps_of_the_recording(make_log: MakeLog, tmp_path: Path) -> None:
    source = list(open_log(make_log(6)))
    unix = [1.7e9 + k / 3 + 1e-7 for k in range(6)]
    frames = [replace(frame, stamp=at, index=10 * k) for k, (frame, at) in enumerate(zip(source, unix, strict=True))]
    recorded = RecordedCamera(GivenFrames([frames[0], *frames]), tmp_path / "a.mcap")
    seen = [(frame.index, number, frame.stamp) for number, frame in recorded.arrivals()]
    read = [frame.stamp for frame in open_log(tmp_path / "a.mcap")]
    assert all(index == number and stamp == read[index] for index, number, stamp in seen)
    assert read == pytest.approx(unix, abs=2e-7)


def test_it_ends_after_a_number_of_frames_or_seconds(
    make_log: MakeLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = open_log(make_log(20, period=0.05))
    three = RecordedCamera(ReplayCamera(log), tmp_path / "a.mcap", max_frames=3)
    list(three.arrivals())
    assert len(three) == len(open_log(tmp_path / "a.mcap")) == 3
    now = [100.0]
    clock = SimpleNamespace(monotonic=lambda: now[0])

    class Timed(GivenFrames):
        """Each frame comes 0.05 s after the one before, on the clock of the recording."""

        def __iter__(self) -> Iterator[Frame]:
            for frame in self._frames:
                now[0] += 0.05
                yield frame

    monkeypatch.setattr(live, "time", clock)
    brief = RecordedCamera(Timed(list(log)), tmp_path / "b.mcap", seconds=0.33)
    list(brief.arrivals())
    assert len(brief) == 8  # the clock of the recording starts with the first


def test_frames_up_to_the_loss_of_the_device_are_kept(
    make_log: MakeLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatbot.robots.cameras.replay._QUEUE", 8)
    camera = ReplayCamera(open_log(make_log(8, period=0.02)), ReplayOptions(unplug=5))
    recorded = RecordedCamera(camera, tmp_path / "a.mcap")
    with pytest.raises(DeviceError, match="gone"):
        list(recorded.arrivals())
    assert len(open_log(tmp_path / "a.mcap")) == 5


def test_frames_whose_stamps_do_not_increase_are_left_out(
    make_log: MakeLog, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frames = list(open_log(make_log(4)))
    again = [frames[0], frames[1], frames[1], frames[0], frames[2], frames[3]]
    with caplog.at_level(logging.WARNING):
        recorded = RecordedCamera(GivenFrames(again), tmp_path / "a.mcap")
        list(recorded.arrivals())
    assert len(recorded) == len(open_log(tmp_path / "a.mcap")) == 4
    assert caplog.text.count("left out") == 1  # once for frames in a row


def test_a_clock_that_was_set_back_ends_the_recording(
    make_log: MakeLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "_LATE_S", 0.2)
    frames = list(open_log(make_log(3)))

    class SetBack(GivenFrames):
        def __iter__(self) -> Iterator[Frame]:
            yield from frames
            while True:
                time.sleep(0.02)
                yield replace(frames[0], stamp=-3600.0)

    recorded = RecordedCamera(SetBack(frames), tmp_path / "a.mcap")
    with pytest.raises(LogError, match="went back by 3600"):
        list(recorded.arrivals())
    assert len(open_log(tmp_path / "a.mcap")) == 3


def test_a_silent_camera_ends_after_its_seconds(
    make_log: MakeLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The seconds end in a silence of a minute, once both frames before it are recorded; those after it are not."""
    recording: list[RecordedCamera] = []

    class Seconds(threading.Timer):
        def run(self) -> None:
            until(lambda: recording and len(recording[0]) == 2)
            super().run()

    monkeypatch.setattr(live.threading, "Timer", Seconds)
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: 0.0))  # no frame ends it
    camera = ReplayCamera(open_log(make_log(4)), ReplayOptions(stall=2, stall_s=60))
    recording.append(RecordedCamera(camera, tmp_path / "a.mcap", seconds=0.5))
    list(recording[0].arrivals())
    assert len(recording[0]) == len(open_log(tmp_path / "a.mcap")) == 2


def test_an_existing_recording_is_replaced_only_by_a_complete_one(make_log: MakeLog, tmp_path: Path) -> None:
    log = open_log(make_log(3))
    list(RecordedCamera(ReplayCamera(log), tmp_path / "a.mcap").arrivals())
    again = RecordedCamera(ReplayCamera(log), tmp_path / "a.mcap", max_frames=1, overwrite=True)
    assert len(open_log(tmp_path / "a.mcap")) == 3
    list(again.arrivals())
    assert len(open_log(tmp_path / "a.mcap")) == 1


def test_images_of_another_camera_end_it_with_its_recording_kept(make_log: MakeLog, tmp_path: Path) -> None:
    frames = list(open_log(make_log(3)))
    frames[2] = replace(frames[2], camera=replace(frames[2].camera, fx=99.0))
    recorded = RecordedCamera(GivenFrames(frames), tmp_path / "a.mcap")
    with pytest.raises(LogError, match="changed"):
        list(recorded.arrivals())
    assert len(open_log(tmp_path / "a.mcap")) == 2


def test_a_camera_without_frames_and_an_existing_file_are_refused(make_log: MakeLog, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="first frame"):
        RecordedCamera(GivenFrames([]), tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()
    (tmp_path / "b.mcap").touch()
    with pytest.raises(LogError, match="exists"):
        RecordedCamera(GivenFrames(list(open_log(make_log(1)))), tmp_path / "b.mcap")


def test_a_frame_is_readable_only_when_the_recording_ended(make_log: MakeLog, tmp_path: Path) -> None:
    recorded = RecordedCamera(ReplayCamera(open_log(make_log(4, period=0.1))), tmp_path / "a.mcap")
    arrivals = recorded.arrivals()
    next(arrivals)
    with pytest.raises(LogError, match="being recorded"):
        recorded[0]
    recorded.close()
    assert recorded[0].index == 0
