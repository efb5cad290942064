"""Imu topics: recorded samples are read back bit for bit, others by TF in the axes of the camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from splatbot.frame import Frame
from splatbot.geometry import Array, so3_exp
from splatbot.imu import ImuSamples
from splatbot.logs import open_log
from splatbot.logs.live import RecordedCamera
from splatbot.logs.mcap import record_mcap
from splatbot.logs.rig import RigLog
from splatbot.logs.ros_imu import ACCEL, GYRO, RecordedImu
from splatbot.logs.ros_types import build
from tests.unit.logs.test_live import GivenFrames

SMALL = "synthetic:tabletop?width=32&height=24&trajectory=turns&frames=4&imu=200"


def test_a_recording_has_the_samples_of_its_frames_and_other_readers_see_imu_messages(tmp_path: Path) -> None:
    log = open_log(SMALL)
    path = record_mcap(log, tmp_path / "a.mcap")
    for frame, source in zip(open_log(path), log, strict=True):
        assert frame.imu is not None
        assert source.imu is not None
        for name in ("gyroscope", "accelerometer"):
            ours, theirs = getattr(frame.imu, name), getattr(source.imu, name)
            np.testing.assert_array_equal(ours[:, 1:], theirs[:, 1:])
            np.testing.assert_allclose(ours[:, 0], theirs[:, 0], atol=1e-9)
    with AnyReader([path]) as reader:
        topics = {c.topic: c.msgcount for c in reader.connections if c.msgtype == "sensor_msgs/msg/Imu"}
    assert topics == {GYRO: 21, ACCEL: 21}  # 0.1 s at 200 Hz, both ends included


def test_a_slow_reader_has_the_samples_of_the_frames_that_it_misses(tmp_path: Path) -> None:
    recorded = RecordedCamera(GivenFrames(list(open_log(SMALL))), tmp_path / "a.mcap")
    recorded.close()  # all frames have arrived, and none was read
    ((_, newest),) = recorded.arrivals()
    assert newest.imu is not None
    assert len(newest.imu.gyro_stamps) == 21


def test_the_time_offset_of_a_camera_moves_its_samples(tmp_path: Path) -> None:
    for name in ("a", "b"):
        record_mcap(open_log(SMALL), tmp_path / f"{name}.mcap")
    file = tmp_path / "rig.yaml"
    file.write_text("cameras: {a: {log: a.mcap}, b: {log: b.mcap, time_offset: 0.01}}")
    first, second = (frame for frame in RigLog(file, lambda path, _: open_log(path)) if 0.03 < frame.stamp < 0.05)
    assert first.imu is not None
    assert second.imu is not None
    np.testing.assert_allclose(second.imu.gyro_stamps, first.imu.gyro_stamps + 0.01, atol=1e-12)


def messages(topic: str, rows: Array, frame_id: str, recorded: RecordedImu, **values: object) -> None:
    for stamp, x, y, z in rows.tolist():
        time = {"sec": int(stamp), "nanosec": round((stamp - int(stamp)) * 1e9)}
        vector = {"angular_velocity": {"x": x, "y": y, "z": z}, "header": {"frame_id": frame_id, "stamp": time}}
        recorded.add(topic, build("sensor_msgs/msg/Imu", vector | values))


def test_samples_of_other_axes_are_turned_by_tf_and_those_without_tf_are_left_out_with_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rows = np.column_stack([np.arange(5) / 100, np.random.default_rng(0).normal(size=(5, 3))])
    T = np.eye(4)
    T[:3, :3] = so3_exp([0.3, -1.2, 0.7])
    recorded = RecordedImu()
    messages("/imu", rows, "imu", recorded)
    messages("/base/imu", np.tile(rows, (2, 1)), "base", recorded)
    known = {("camera", "imu"): T}
    found = recorded.samples("camera", lambda target, source: known.get((target, source)))
    assert found is not None
    np.testing.assert_allclose(found.angular_rate, rows[:, 1:] @ T[:3, :3].T, atol=1e-15)
    assert not len(found.accel_stamps)  # always 0: not measured
    assert "/base/imu is not used in tracking" in caplog.text
    assert recorded.samples("other", lambda *_: None) is None


def test_a_vector_that_is_marked_as_not_measured_is_not() -> None:
    recorded = RecordedImu()
    messages("/imu", np.ones((3, 4)), "camera", recorded, angular_velocity_covariance=[-1.0, *8 * [0.0]])
    assert recorded.samples("camera", lambda *_: None) is None


def test_a_frame_is_shifted_with_its_samples() -> None:
    frame: Frame = open_log(SMALL)[2]
    moved = frame.shifted(3.0)
    assert isinstance(frame.imu, ImuSamples)
    assert moved.imu is not None
    assert moved.stamp == frame.stamp + 3.0
    np.testing.assert_array_equal(moved.imu.gyro_stamps, frame.imu.gyro_stamps + 3.0)
