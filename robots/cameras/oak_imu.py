"""IMU of OAK cameras: depthai's packets as samples on the clock and in the axes of the colour camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatbot.imu import ImuSamples
from splatbot.protocols import Array
from splatbot.robots.cameras.imu_buffer import factory_axes, warn_of_unused_imu


@dataclass(frozen=True)
class OakImuConstants:
    """Constants of the IMU.

    Args:
        gyro_rate: requested rate [Hz] of the gyroscope. Sensors round it to one of theirs.
        accel_rate: requested rate [Hz] of the accelerometer.
        batch: largest number of packets of a message.
        queue: messages that wait for the next frame; older ones are dropped.
    """

    gyro_rate: int = 200
    accel_rate: int = 100
    batch: int = 10
    queue: int = 1000


CONSTANTS = OakImuConstants()


class OakImu:
    """Collects the packets of an IMU and returns the samples up to each frame.

    A packet has a report of each sensor with a stamp of its own. The sensors have different rates, so that packets
    repeat the last report of the slower one. A report without a stamp is empty. ``getTimestamp`` is the time on the
    clock of the host, as for images; ``getTimestampDevice`` has another zero.

    Args:
        output: output of the IMU node.
        R_camera_imu: (3, 3) axes of the IMU in those of the camera.
        unix: Unix time [s] at the zero of depthai's clock.
    """

    def __init__(self, output: Any, R_camera_imu: Array, unix: float) -> None:
        self._queue = output.createOutputQueue(maxSize=CONSTANTS.queue, blocking=False)
        self._R_camera_imu, self._unix = R_camera_imu, unix
        self._waiting = ImuSamples.of()
        self._newest = {"gyroscope": 0.0, "acceleroMeter": 0.0}  # [s] of depthai's clock

    def until(self, stamp: float) -> ImuSamples:
        """Return the samples up to a time [s] that were not returned yet; later ones wait for the next frame."""
        messages = [] if self._queue.isClosed() else self._queue.tryGetAll()
        packets = [packet for message in messages for packet in message.packets]
        new = ImuSamples.of(self._rows("gyroscope", packets), self._rows("acceleroMeter", packets))
        samples = self._waiting.joined(new)
        self._waiting = samples.between(stamp, np.inf)
        return samples.between(-np.inf, stamp)

    def _rows(self, sensor: str, packets: Sequence[Any]) -> Array:
        """Return Unix time [s] and vector (N, 4) in the axes of the camera, of the new reports of a sensor."""
        reports = [getattr(packet, sensor) for packet in packets]
        rows = np.array([(r.getTimestamp().total_seconds(), r.x, r.y, r.z) for r in reports], np.float64).reshape(-1, 4)
        rows = rows[rows[:, 0] > self._newest[sensor]]
        self._newest[sensor] = float(rows[:, 0].max(initial=self._newest[sensor]))
        return np.column_stack([self._unix + rows[:, 0], rows[:, 1:] @ self._R_camera_imu.T])


def imu_output(pipeline: Any) -> Any:
    """Create the IMU node of a pipeline and return its output.

    The factory calibration is that of the axes of the CALIBRATED reports; RAW reports have those of the chip.
    """
    import depthai

    imu = pipeline.create(depthai.node.IMU)
    imu.enableIMUSensor(depthai.IMUSensor.GYROSCOPE_CALIBRATED, CONSTANTS.gyro_rate)
    imu.enableIMUSensor(depthai.IMUSensor.ACCELEROMETER_CALIBRATED, CONSTANTS.accel_rate)
    imu.setBatchReportThreshold(1)
    imu.setMaxBatchReports(CONSTANTS.batch)
    return imu.out


def factory_rotation(device: Any) -> Array | None:
    """Return the axes (3, 3) of the IMU in those of the colour camera by the factory calibration.

    The result is None, with a warning, if the device has an IMU without such a calibration.
    """
    import depthai

    if device.getConnectedIMU() in ("", "NONE"):
        return None
    try:
        T = device.readCalibration().getImuToCameraExtrinsics(depthai.CameraBoardSocket.CAM_A)
        return factory_axes(np.array(T, np.float64)[:3, :3])
    except (RuntimeError, IndexError, ValueError) as error:  # depthai raises RuntimeError where a link is missing
        warn_of_unused_imu("the OAK", f"its axes are not calibrated ({error})")
        return None
