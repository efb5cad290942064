"""IMU of RealSense cameras: librealsense's motion frames as samples on the clock and in the axes of colour."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from splatbot.imu import ImuSamples
from splatbot.protocols import Array
from splatbot.robots.cameras.imu_buffer import ImuBuffer, factory_axes, warn_of_unused_imu

_GYRO_HZ, _ACCEL_HZ = 200, 100  # requested rates; the sensor has those of its maker


class RealsenseImu:
    """Collects motion frames, and returns the samples up to each frame.

    The pipeline of the images would deliver one sample of each sensor with a pair of images. So the sensor has its own
    callback. Samples are in the clock of their timestamp domain: Unix time, or the clock of the device.

    Args:
        sensor: motion sensor that is not open yet.
        color: stream profile of colour.
        name: of the camera, for warnings.

    Raises:
        RuntimeError: the sensor has no gyroscope or cannot be opened, or its place on the camera is not known.
        ValueError: the factory calibration of its axes is no rotation.
    """

    def __init__(self, sensor: Any, color: Any, name: str) -> None:
        import pyrealsense2 as rs

        gyro, accel = _nearest(sensor, rs.stream.gyro, _GYRO_HZ), _nearest(sensor, rs.stream.accel, _ACCEL_HZ)
        if gyro is None:
            raise RuntimeError("it has no gyroscope")
        R_gyro = _axes(gyro, color)
        R_accel = R_gyro if accel is None else _axes(accel, color)
        self._unix, self._device = (ImuBuffer(R_gyro, R_accel) for _ in range(2))
        self._name, self._warned, self._sensor = name, False, sensor

        def add(frame: Any) -> None:
            at, vector = 1e-3 * frame.get_timestamp(), frame.as_motion_frame().get_motion_data()
            of_device = frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock
            buffer = self._device if of_device else self._unix
            take = buffer.add_rate if frame.profile.stream_type() == rs.stream.gyro else buffer.add_force
            take(at, vector.x, vector.y, vector.z)

        sensor.open([gyro] if accel is None else [gyro, accel])
        sensor.start(add)

    def until(self, stamp: float, device_shift: float | None) -> ImuSamples:
        """Return the samples up to a Unix time [s] that were not returned yet.

        Args:
            stamp: of a frame.
            device_shift: time [s] from the clock of the device to Unix time, None where images do not have that clock.
        """
        samples = self._unix.until(stamp, 0.0)
        if device_shift is not None:
            return samples.joined(self._device.until(stamp, device_shift))
        if len(self._device) and not self._warned:
            self._warned = True
            warn_of_unused_imu(self._name, "its stamps are of the device clock, those of the images are not")
        return samples

    def stop(self) -> None:
        """End the samples; the device may be gone."""
        with contextlib.suppress(RuntimeError):
            self._sensor.stop()
            self._sensor.close()


def open_imu(sensor: Any, color: Any, name: str) -> RealsenseImu | None:
    """Return the IMU of a camera, or None for a camera without one, and with a warning if it cannot be used.

    Args:
        sensor: motion sensor, or None.
        color: stream profile of colour.
        name: of the camera.
    """
    if sensor is None:
        return None
    try:
        return RealsenseImu(sensor, color, name)
    except (RuntimeError, ValueError) as error:
        warn_of_unused_imu(name, error)
        return None


def _nearest(sensor: Any, stream: Any, rate: int) -> Any:
    """Return the profile of a stream whose rate [Hz] is nearest to the wanted one; None without the stream."""
    import pyrealsense2 as rs

    vectors = [profile for profile in sensor.get_stream_profiles() if profile.format() == rs.format.motion_xyz32f]
    of_stream = [profile for profile in vectors if profile.stream_type() == stream]
    return min(of_stream, key=lambda profile: abs(profile.fps() - rate), default=None)


def _axes(motion: Any, color: Any) -> Array:
    """Return the axes (3, 3) of a motion stream in those of colour; librealsense stores them by columns."""
    return factory_axes(np.reshape(motion.get_extrinsics_to(color).rotation, (3, 3)).T)
