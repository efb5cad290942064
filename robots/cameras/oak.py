"""OAK cameras (Luxonis) with depthai 3: colour, and stereo depth that the device aligns to it.

The pipeline has two parts. The device delivers undistorted colour and aligned depth in millimetres; the host pairs
them and adds the packets of the IMU. The host part also runs without a device, on host nodes with recorded packets.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import timedelta
from typing import Any

import cv2
import numpy as np

from splatbot.errors import DeviceError
from splatbot.frame import Frame
from splatbot.layouts import OAK as PREFIX
from splatbot.protocols import Array
from splatbot.robots.cameras.device import CONSTANTS as DEVICE
from splatbot.robots.cameras.device import ImageLens, RgbdDevice
from splatbot.robots.cameras.oak_imu import OakImu, factory_rotation, imu_output
from splatbot.robots.cameras.stream_options import StreamOptions, parse_address

DEFAULT = StreamOptions(width=640, height=400)


@dataclass(frozen=True)
class OakStreams:
    """Outputs of a depthai pipeline.

    Args:
        color, depth: images.
        imu: packets of the IMU; None for a device without one.
        R_camera_imu: (3, 3) axes of the IMU in those of the colour camera.
    """

    color: Any
    depth: Any
    imu: Any = None
    R_camera_imu: Array = field(default_factory=lambda: np.eye(3))


MakeStreams = Callable[[Any, StreamOptions], OakStreams]
"""Creates the nodes of a depthai pipeline and returns their outputs."""


@dataclass(frozen=True)
class OakConstants:
    """Constants of the OAK driver.

    Args:
        queue: pairs that wait for a slow reader; older ones are dropped.
        millimetres: [units/m] of depth.
    """

    queue: int = 4
    millimetres: float = 1000.0


CONSTANTS = OakConstants()


class OakCamera(RgbdDevice):
    """An OAK camera as a source of frames; each iteration opens the device.

    Stamps are Unix time in the middle of the exposure of colour. The library synchronizes the device's clock to the
    host's monotonic clock. The difference of that to Unix time is measured once, when the device is opened.

    Args:
        serial: id, IP address or USB path of the device; empty takes the first one.
        options: requested streams.
        streams: creates the sources. If None, they are those of a device.

    Raises:
        DeviceError: when iterating: no device, it is gone, or it delivers other images than requested.
    """

    def __init__(
        self, serial: str = "", options: StreamOptions = DEFAULT, *, streams: MakeStreams | None = None
    ) -> None:
        super().__init__(PREFIX, serial, options)
        self._streams = streams

    @classmethod
    def from_uri(cls, uri: str) -> OakCamera:
        """Return the camera of `oak://SERIAL?size=640x400&fps=30`; all parts after `oak://` may be missing.

        Raises:
            InputError: an option is unknown or out of range.
        """
        return cls(*parse_address(uri, PREFIX, DEFAULT))

    def __iter__(self) -> Iterator[Frame]:
        dai = _depthai()
        if self._closed.is_set():
            return
        pipeline = dai.Pipeline(createImplicitDevice=False) if self._streams else dai.Pipeline(self._device(dai))
        streams = (self._streams or device_streams)(pipeline, self.options)
        sync = pipeline.create(dai.node.Sync)
        sync.setRunOnHost(True)
        sync.setSyncThreshold(timedelta(seconds=0.5 / self.options.fps))
        streams.color.link(sync.inputs["color"])
        streams.depth.link(sync.inputs["depth"])
        queue = sync.out.createOutputQueue(maxSize=CONSTANTS.queue, blocking=False)
        unix = time.time() - dai.Clock.now().total_seconds()
        imu = None if streams.imu is None else OakImu(streams.imu, streams.R_camera_imu, unix)

        def wait() -> Any:
            if not pipeline.isRunning():
                raise RuntimeError("its connection ended")
            try:
                return queue.get(timedelta(seconds=DEVICE.poll_s))
            except dai.MessageQueue.QueueException as error:
                raise RuntimeError(str(error)) from error

        pipeline.start()
        try:
            for pair in self._pairs(wait, lambda pair: pair["color"].getSequenceNum()):
                frame = self._frame(dai, pair["color"], pair["depth"], unix)
                yield frame if imu is None else replace(frame, imu=imu.until(frame.stamp))
        finally:
            pipeline.stop()
            pipeline.wait()

    def _device(self, dai: Any) -> Any:
        try:
            return dai.Device(dai.DeviceInfo(self._serial)) if self._serial else dai.Device()
        except RuntimeError as error:
            hint = (
                "plug it into a USB 3 port, or give its IP address as in oak://192.168.1.44. On Linux, a udev rule for "
                "vendor 03e7 gives access"
            )
            raise self._cannot_be_opened(error, hint) from error

    def _frame(self, dai: Any, color: Any, depth: Any, unix: float) -> Frame:
        """Convert a pair of messages.

        Raises:
            DeviceError: depth is not in millimetres, the sizes differ, or the intrinsics are missing. A lens cannot be
                rectified.
        """
        if depth.getType() != dai.ImgFrame.Type.RAW16:
            raise self._wrong(f"depth is {depth.getType().name}, not RAW16")
        bgr, units = color.getCvFrame(), depth.getFrame()
        if bgr.ndim != 3 or bgr.shape[:2] != units.shape:
            raise self._wrong(f"colour is {bgr.shape}, depth is {units.shape} (rows, columns)")
        rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        metres = units.astype(np.float32) / np.float32(CONSTANTS.millimetres)
        middle = dai.CameraExposureOffset.MIDDLE
        at, depth_at = (image.getTimestamp(middle).total_seconds() for image in (color, depth))
        lenses = self._lens(dai, color, color, "colour"), self._lens(dai, color, depth, "depth")
        return self._next_frame(unix + at, rgb, metres, lenses, depth_at - at)

    def _lens(self, dai: Any, color: Any, image: Any, name: str) -> ImageLens:
        """Return the lens of an image by its own transformation, with the pixels of colour.

        depthai scales and crops the factory calibration with the images, and clears the coefficients of those that it
        undistorts. Its ImageAlign removes the distortion of depth also where that of colour stays.

        Raises:
            DeviceError: the lens is of another model, or makes no sense.
        """
        K = np.array(color.getTransformation().getIntrinsicMatrix(), dtype=np.float64)
        model = image.getTransformation().getDistortionModel()
        coefficients = tuple(float(value) for value in image.getTransformation().getDistortionCoefficients())
        models = dai.CameraModel
        panorama = model.name in ("Equirectangular", "Cylindrical")  # without coefficients; depthai 3.0 has one of them
        if panorama or (any(coefficients) and model not in (models.Perspective, models.Fisheye)):
            raise self._unknown_lens(model.name, name)
        fisheye = model == models.Fisheye
        size = (color.getWidth(), color.getHeight())
        kept = coefficients[:4] if fisheye else coefficients
        return ImageLens(self._camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], size=size, distortion=kept, fisheye=fisheye))


def device_streams(pipeline: Any, options: StreamOptions) -> OakStreams:
    """Create the nodes of a device: undistorted colour, stereo depth in its pixels, and the IMU if there is one.

    RVC2 aligns depth in its stereo node, RVC4 in a node of its own (depthai's example "Depth Align").
    """
    dai = _depthai()
    size, sockets = (options.width, options.height), dai.CameraBoardSocket
    camera = pipeline.create(dai.node.Camera).build(sockets.CAM_A)
    color = camera.requestOutput(size, dai.ImgFrame.Type.RGB888i, fps=options.fps, enableUndistortion=True)
    stereo = pipeline.create(dai.node.StereoDepth)
    stereo.setDefaultProfilePreset(dai.node.StereoDepth.PresetMode.ROBOTICS)
    for socket, side in ((sockets.CAM_B, stereo.left), (sockets.CAM_C, stereo.right)):
        pipeline.create(dai.node.Camera).build(socket).requestOutput((640, 400), fps=options.fps).link(side)
    device = pipeline.getDefaultDevice()
    R_camera_imu = factory_rotation(device)
    imu = None if R_camera_imu is None else imu_output(pipeline)
    axes = np.eye(3) if R_camera_imu is None else R_camera_imu
    if device.getPlatform() == dai.Platform.RVC4:
        align = pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(align.input)
        color.link(align.inputAlignTo)
        return OakStreams(color, align.outputAligned, imu, axes)
    color.link(stereo.inputAlignTo)
    return OakStreams(color, stereo.depth, imu, axes)


def _depthai() -> Any:
    os.environ.setdefault("DEPTHAI_LEVEL", "error")  # without it, depthai warns of USB in every container
    # Its signal handler would end the process where a disk is full (SIGXFSZ), which Python ignores.
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
    os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", "5000")  # [ms]; a device that was reset is back by then
    try:
        import depthai
    except ImportError as error:
        hint = "install it: pip install depthai"
        raise DeviceError(f"needs depthai ({error}).", file=PREFIX, field="camera", hint=hint) from error
    return depthai
