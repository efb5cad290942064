"""Packets of an OAK camera, sent into a depthai pipeline by host nodes instead of a device."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

os.environ.setdefault("DEPTHAI_LEVEL", "error")
os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")

import depthai as dai
import numpy as np
from numpy.typing import NDArray

from splatbot.robots.cameras.oak import OakStreams
from splatbot.robots.cameras.stream_options import StreamOptions

PERIOD_S = 1 / 30


@dataclass(frozen=True)
class Packet:
    """An image as the device sends it.

    Args:
        stamp: [s] of depthai's clock, at the end of the exposure.
        image: pixels, (H, W, 3) or (H, W).
        kind: name of its depthai type.
        K: (3, 3) intrinsic matrix.
        sequence: its number.
        lens: distortion in depthai's order, which is OpenCV's.
        model: name of the depthai camera model.
    """

    stamp: float
    image: NDArray[Any]
    kind: str
    K: NDArray[np.float64]
    sequence: int
    lens: tuple[float, ...] = ()
    model: str = "Perspective"

    @property
    def transformation(self) -> Any:
        """Its geometry as depthai has it."""
        height, width = self.image.shape[:2]
        lens = [*self.lens, *[0.0] * (14 - len(self.lens))]
        return dai.ImgTransformation(width, height, self.K.tolist(), getattr(dai.CameraModel, self.model), lens)

    def message(self) -> Any:
        """Return it as depthai has it."""
        height, width = self.image.shape[:2]
        message = dai.ImgFrame()
        message.setData(np.ascontiguousarray(self.image).view(np.uint8).ravel())  # type: ignore[arg-type]
        message.setWidth(width)
        message.setHeight(height)
        message.setStride(self.image.strides[0])
        message.setType(getattr(dai.ImgFrame.Type, self.kind))
        message.setTimestamp(timedelta(seconds=self.stamp))
        message.setSequenceNum(self.sequence)
        message.setTransformation(self.transformation)
        return message


@dataclass(frozen=True)
class ImuReport:
    """Reports of the two sensors in one packet of the IMU; a sensor without a stamp has an empty report.

    Args:
        gyro_stamp, accel_stamp: [s] of depthai's clock.
        rate: [rad/s].
        force: [m/s²].
        device_offset: time [s] of the device's clock less that of depthai.
    """

    gyro_stamp: float | None
    rate: tuple[float, float, float]
    accel_stamp: float | None
    force: tuple[float, float, float]
    device_offset: float = 0.0

    def packet(self) -> Any:
        """Return it as depthai has it."""
        packet = dai.IMUPacket()
        reports = (packet.gyroscope, self.gyro_stamp, self.rate), (packet.acceleroMeter, self.accel_stamp, self.force)
        for report, stamp, vector in reports:
            if stamp is not None:
                report.x, report.y, report.z = vector
                report.timestamp, report.tsDevice = _timestamp(stamp), _timestamp(stamp + self.device_offset)
        return packet


def _timestamp(seconds: float) -> Any:
    time = dai.Timestamp()
    time.sec, time.nsec = int(seconds), round((seconds - int(seconds)) * 1e9)
    return time


@dataclass(frozen=True)
class ImuMessage:
    """A batch of packets of the IMU."""

    reports: Sequence[ImuReport]

    def message(self) -> Any:
        """Return it as depthai has it."""
        message = dai.IMUData()
        message.packets = [report.packet() for report in self.reports]
        return message


class _Sender(dai.node.ThreadedHostNode):
    def __init__(self) -> None:
        super().__init__()
        self.out = self.createOutput()
        self.packets: Sequence[Packet | ImuMessage] = ()

    def run(self) -> None:
        for packet in self.packets:
            if not self.isRunning():
                return
            self.out.send(packet.message())
            time.sleep(PERIOD_S)


class RecordedStreams:
    """Sources of :class:`splatbot.robots.cameras.oak.OakCamera` that send packets."""

    def __init__(
        self,
        color: Sequence[Packet],
        depth: Sequence[Packet],
        imu: Sequence[ImuMessage] | None = None,
        R_camera_imu: NDArray[np.float64] | None = None,
    ) -> None:
        self._color, self._depth, self._imu = color, depth, imu
        self._R_camera_imu = np.eye(3) if R_camera_imu is None else R_camera_imu

    def __call__(self, pipeline: Any, _options: StreamOptions) -> OakStreams:
        """Create the nodes in a pipeline and return their outputs."""
        outputs: list[Any] = []
        for packets in (self._color, self._depth, self._imu):
            if packets is None:
                outputs.append(None)
                continue
            sender = pipeline.create(_Sender)
            sender.packets = packets
            outputs.append(sender.out)
        color, depth, imu = outputs
        return OakStreams(color, depth, imu, self._R_camera_imu)
