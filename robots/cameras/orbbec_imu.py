"""IMU of Orbbec cameras: samples on the clock and in the axes of colour."""

from __future__ import annotations

import contextlib
from typing import Any

from splatbot.imu import ImuSamples
from splatbot.robots.cameras.imu_buffer import ImuBuffer, factory_axes, warn_of_unused_imu

MICROSECOND = 1e-6  # [s] unit of the stamps of the library


class OrbbecImu:
    """Collects samples with a pipeline of their own, and returns those up to each frame.

    The pipeline of the images would deliver one sample of each sensor with a pair of images.

    Args:
        ob: module pyorbbecsdk.
        device: that of the images.
        color: stream profile of colour.
        has_clock: whether stamps are those of the global clock, else of the device clock.

    Raises:
        RuntimeError: a sensor cannot be started, or its place on the camera is not known.
        ValueError: the factory calibration of the axes is no rotation.
    """

    def __init__(self, ob: Any, device: Any, color: Any, *, has_clock: bool) -> None:
        self._error = ob.OBError
        try:
            self._pipeline = ob.Pipeline(device)
            kinds = ob.OBSensorType.GYRO_SENSOR, ob.OBSensorType.ACCEL_SENSOR
            profiles = (self._pipeline.get_stream_profile_list(kind).get_stream_profile_by_index(0) for kind in kinds)
            buffer = ImuBuffer(*(factory_axes(profile.get_extrinsic_to(color).rot) for profile in profiles))
            self._buffer = buffer

            def add(samples: Any) -> None:
                for sample, take in (
                    (samples.get_gyro_frame(), buffer.add_rate),
                    (samples.get_accel_frame(), buffer.add_force),
                ):
                    if sample is not None:
                        at = MICROSECOND * stamp_of(sample, has_clock=has_clock)
                        take(at, sample.get_x(), sample.get_y(), sample.get_z())

            self._start(ob, add)
        except ob.OBError as error:
            raise RuntimeError(str(error)) from error

    def _start(self, ob: Any, add: Any) -> None:
        """Start both sensors at 200 Hz, or at the default rate of a device that does not have it."""
        rates = ob.OBGyroSampleRate
        try:
            self._pipeline.start(_config(ob, rates.SAMPLE_RATE_200_HZ), add)
        except ob.OBError:
            self._pipeline.start(_config(ob, rates.SAMPLE_RATE_UNKNOWN), add)

    def until(self, stamp: float, shift: float) -> ImuSamples:
        """Return the samples up to a Unix time [s] that were not returned yet.

        Args:
            stamp: of a frame.
            shift: time [s] from the clock of the stamps to Unix time.
        """
        return self._buffer.until(stamp, shift)

    def stop(self) -> None:
        """End the samples; the device may be gone."""
        with contextlib.suppress(self._error):
            self._pipeline.stop()


def open_imu(ob: Any, device: Any, color: Any, name: str, *, has_clock: bool) -> OrbbecImu | None:
    """Return the IMU of a device, or None for one without it, and with a warning if it cannot be used.

    Args:
        ob: module pyorbbecsdk.
        device: the device.
        color: stream profile of colour.
        name: of the camera.
        has_clock: whether stamps are those of the global clock, else of the device clock.
    """
    sensors = device.get_sensor_list()
    kinds = {sensors.get_type_by_index(index) for index in range(sensors.get_count())}
    if not {ob.OBSensorType.GYRO_SENSOR, ob.OBSensorType.ACCEL_SENSOR} <= kinds:
        return None
    try:
        return OrbbecImu(ob, device, color, has_clock=has_clock)
    except (RuntimeError, ValueError) as error:
        warn_of_unused_imu(name, error)
        return None


def stamp_of(frame: Any, *, has_clock: bool) -> int:
    """Return the stamp [us] of an image or a sample in the global clock, or in that of the device."""
    return int(frame.get_global_timestamp_us() if has_clock else frame.get_timestamp_us())


def _config(ob: Any, rate: Any) -> Any:
    """Return the configuration of both sensors, whose samples arrive one by one."""
    config = ob.Config()
    config.enable_gyro_stream(sample_rate=rate)
    config.enable_accel_stream(sample_rate=rate)
    config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.DISABLE)
    return config
