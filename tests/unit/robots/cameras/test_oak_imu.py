"""IMU of OAK cameras: made packets through a depthai pipeline without a device, and calibrations that make no sense."""

from __future__ import annotations

import logging
import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.frame import Frame
from splatbot.geometry import so3_exp
from splatbot.logs import open_log
from splatbot.logs.live import RecordedCamera
from splatbot.protocols import Array
from splatbot.robots.cameras import OakCamera
from splatbot.robots.cameras.oak_imu import factory_rotation
from tests.conftest import MakeLog
from tests.unit.robots.cameras.recorded_packets import (
    PERIOD_S,
    ImuMessage,
    ImuReport,
    Packet,
    RecordedStreams,
    dai,
)

R_CAMERA_IMU = so3_exp([0.4, -1.1, 0.6])
GYRO_S, ACCEL_S = 0.005, 0.008


def streams(frames: list[Frame]) -> tuple[RecordedStreams, float]:
    """Return the packets of a device with a gyroscope of 200 Hz and an accelerometer of 125 Hz, and its start [s].

    As depthai does, each packet repeats the last report of the other sensor. The device's clock began 1000 s later.
    """
    now = dai.Clock.now().total_seconds()  # type: ignore[call-arg]
    color = [Packet(now + PERIOD_S * k, f.rgb, "RGB888i", f.camera.K, k) for k, f in enumerate(frames)]
    units = [np.round(1000 * f.depth).astype(np.uint16) for f in frames]
    depth = [Packet(p.stamp, z, "RAW16", p.K, p.sequence) for p, z in zip(color, units, strict=True)]
    reports, end = [], PERIOD_S * len(frames)
    events = sorted({*np.arange(0, end, GYRO_S).round(6), *np.arange(0.002, end, ACCEL_S).round(6)})
    for t in events:
        gyro = GYRO_S * int(t / GYRO_S + 1e-6)
        since = t - 0.002
        accel = None if since < -1e-9 else 0.002 + ACCEL_S * int(since / ACCEL_S + 1e-6)
        force = (0.0, 0.0, 0.0) if accel is None else (accel, 1.0, 2.0)
        at = None if accel is None else now + accel
        reports.append((t, ImuReport(now + gyro, (gyro, -1.0, 0.5), at, force, device_offset=-min(1000.0, now - 1))))
    batches = [[r for t, r in reports if PERIOD_S * (k - 1) < t <= PERIOD_S * k] for k in range(len(frames) + 1)]
    return RecordedStreams(color, depth, [ImuMessage(b) for b in batches], R_CAMERA_IMU), now


def rows_of(frames: list[Frame], name: str) -> Array:
    return np.concatenate([getattr(frame.imu, name) for frame in frames])


def test_samples_have_the_clock_and_axes_of_the_images_and_no_report_is_repeated(make_log: MakeLog) -> None:
    source, begun = list(open_log(make_log(6))), time.time()
    recorded, _ = streams(source)
    camera = OakCamera(streams=recorded)
    frames = list(islice(iter(camera), 6))
    camera.close()
    for name, period, first in (("gyroscope", GYRO_S, 0.0), ("accelerometer", ACCEL_S, 0.002)):
        rows = rows_of(frames, name)
        assert len(rows) >= 2 * PERIOD_S / period  # a busy machine delivers the last ones late
        assert abs(rows[0, 0] - begun) < 2.0  # Unix time, not that of the device
        np.testing.assert_allclose(np.diff(rows[:, 0]), period, atol=3e-6)
        vectors = rows[:, 1:] @ R_CAMERA_IMU  # in the axes of the IMU
        stated = rows[:, 0] - frames[0].stamp  # each report holds its own time in its first component
        np.testing.assert_allclose(vectors[:, 0], stated, atol=1e-5)
        assert vectors[0, 0] == pytest.approx(first, abs=1e-5)
        rest = [-1.0, 0.5] if name == "gyroscope" else [1.0, 2.0]
        np.testing.assert_allclose(vectors[:, 1:], np.tile(rest, (len(rows), 1)), atol=1e-6)
    assert all(frame.imu is not None and (frame.imu.gyro_stamps <= frame.stamp).all() for frame in frames)


def test_a_recording_keeps_the_samples(make_log: MakeLog, tmp_path: Path) -> None:
    recorded, _ = streams(list(open_log(make_log(10))))
    with_imu = RecordedCamera(OakCamera(streams=recorded), tmp_path / "a.mcap", max_frames=4)
    seen = [frame for _, frame in with_imu.arrivals()]
    back = list(open_log(tmp_path / "a.mcap"))
    assert len(back) == 4
    rows = rows_of(back, "gyroscope")
    np.testing.assert_allclose(np.diff(rows[:, 0]), GYRO_S, atol=3e-6)
    np.testing.assert_array_equal(rows[:, 1:], rows_of(seen, "gyroscope")[:, 1:])


def test_a_device_without_an_imu_delivers_frames_without_samples(make_log: MakeLog) -> None:
    source = list(open_log(make_log(2)))
    recorded, _ = streams(source)
    recorded._imu = None
    camera = OakCamera(streams=recorded)
    assert [frame.imu for frame in islice(iter(camera), 2)] == [None, None]
    camera.close()


class Device:
    """The calls of a depthai device that state its IMU."""

    def __init__(self, imu: str, T: Array | None) -> None:
        self._imu, self._T = imu, T

    def getConnectedIMU(self) -> str:
        return self._imu

    def readCalibration(self) -> Device:
        return self

    def getImuToCameraExtrinsics(self, _socket: Any) -> list[list[float]]:
        if self._T is None:
            raise RuntimeError("no link")
        return self._T.tolist()


def test_axes_are_those_of_the_factory_and_a_device_without_them_has_no_samples(
    caplog: pytest.LogCaptureFixture,
) -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_CAMERA_IMU, [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(factory_rotation(Device("BMI270", T)), R_CAMERA_IMU)
    with caplog.at_level(logging.WARNING):
        assert factory_rotation(Device("", T)) is None
        assert not caplog.text
        for wrong in (None, np.zeros((4, 4)), np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)):
            caplog.clear()
            assert factory_rotation(Device("BMI270", wrong)) is None
            assert "axes are not calibrated" in caplog.text
