"""RealSense cameras with pyrealsense2 (extra `realsense`): colour, and depth that librealsense aligns to it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from splatbot.errors import DeviceError
from splatbot.frame import Frame
from splatbot.layouts import REALSENSE as PREFIX
from splatbot.logs.undistort import modified_source_pixels
from splatbot.robots.cameras.device import CONSTANTS as DEVICE
from splatbot.robots.cameras.device import ImageLens, RgbdDevice
from splatbot.robots.cameras.realsense_align import aligns_with_lens
from splatbot.robots.cameras.realsense_imu import open_imu
from splatbot.robots.cameras.stream_options import StreamOptions, parse_address

DEFAULT = StreamOptions(width=640, height=480)


class FrameSets(Protocol):
    """Synchronized images of a device.

    Attributes:
        color: stream profile of colour.
        motion: sensor of the gyroscope and the accelerometer, not open yet; None for a device without one.
    """

    color: Any
    motion: Any

    def wait(self, milliseconds: int) -> Any:
        """Return the next set with colour and depth, or None after a time without one."""
        ...

    def stop(self) -> None:
        """End the streams."""
        ...


OpenStreams = Callable[[str, StreamOptions], FrameSets]
"""Opens the streams of the device with a serial number.

Raises RuntimeError as librealsense does: no device, or no such streams.
"""


class RealsenseCamera(RgbdDevice):
    """A RealSense camera as a source of frames; each iteration opens the device.

    Stamps of librealsense in global or system time are Unix time. Those of the device's own clock are shifted to Unix
    time by the first image that has it. Frames have the samples of the IMU, if there is one.

    Args:
        serial: serial number; empty takes the first device.
        options: requested streams.
        open_streams: opens the streams. If None, they are those of a device.

    Raises:
        DeviceError: when iterating: pyrealsense2 is missing, there is no device, or it is gone.
    """

    def __init__(
        self, serial: str = "", options: StreamOptions = DEFAULT, *, open_streams: OpenStreams | None = None
    ) -> None:
        super().__init__(PREFIX, serial, options)
        self._open = open_streams or DeviceStreams

    @classmethod
    def from_uri(cls, uri: str) -> RealsenseCamera:
        """Return the camera of `realsense://SERIAL?size=640x480&fps=30`; all parts after `realsense://` may be missing.

        Raises:
            InputError: an option is unknown or out of range.
        """
        return cls(*parse_address(uri, PREFIX, DEFAULT))

    def __iter__(self) -> Iterator[Frame]:
        rs = _pyrealsense()
        if self._closed.is_set():
            return
        try:
            streams = self._open(self._serial, self.options)
        except RuntimeError as error:
            hint = "plug it into a USB 3 port; `rs-enumerate-devices` lists its sizes and rates, and its serial number"
            raise self._cannot_be_opened(error, hint) from error
        imu = open_imu(streams.motion, streams.color, self.uri)
        try:
            align = rs.align(rs.stream.color)
            shift: float | None = None  # [s] from the clock of the device to Unix time
            poll_ms = round(1e3 * DEVICE.poll_s)
            for pair in self._pairs(lambda: streams.wait(poll_ms), _number_of):
                aligned = align.process(pair)
                color, depth = aligned.get_color_frame(), aligned.get_depth_frame()
                at, depth_at = (1e-3 * image.get_timestamp() for image in (color, depth))
                clock, depth_clock = (image.get_frame_timestamp_domain() for image in (color, depth))
                of_device = clock == rs.timestamp_domain.hardware_clock
                if of_device and shift is None:
                    shift = time.time() - at
                stamp = at + shift if of_device and shift is not None else at
                rgb = np.array(color.get_data())  # a copy: the buffer belongs to librealsense
                metres = np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(depth.get_units())
                delay = depth_at - at if clock == depth_clock else 0.0
                frame = self._next_frame(stamp, rgb, metres, self._lenses(rs, color), delay)
                yield frame if imu is None else replace(frame, imu=imu.until(stamp, shift))
        finally:
            if imu is not None:
                imu.stop()
            streams.stop()

    def _lenses(self, rs: Any, color: Any) -> tuple[ImageLens, ImageLens]:
        """Return the lens of colour, and that of the depth which the library has aligned to it.

        "Brown-Conrady" and "Kannala-Brandt" are OpenCV's models. The library projects with "inverse Brown-Conrady", the
        model of D400 colour, as with "modified Brown-Conrady" (librealsense 2.50 and later).

        Raises:
            DeviceError: the lens is of another model, or makes no sense.
        """
        i, models = color.profile.as_video_stream_profile().intrinsics, rs.distortion
        coefficients = tuple(float(value) for value in i.coeffs) if i.model != models.none else ()
        modified = i.model in (models.inverse_brown_conrady, models.modified_brown_conrady)
        fisheye = i.model == models.kannala_brandt4
        if any(coefficients) and not (modified or fisheye or i.model == models.brown_conrady):
            raise self._unknown_lens(i.model.name)
        kept = coefficients[:4] if fisheye else coefficients
        camera = self._camera(i.fx, i.fy, i.ppx, i.ppy, size=(i.width, i.height), distortion=kept, fisheye=fisheye)
        lens = ImageLens(camera, modified_source_pixels if modified else None)
        return lens, lens if camera.distortion and self._aligns_with_lens(i.model) else ImageLens(camera.pinhole)

    def _aligns_with_lens(self, model: Any) -> bool:
        try:
            return aligns_with_lens(model)
        except RuntimeError as error:
            raise self._wrong(str(error)) from error


class DeviceStreams:
    """The streams of a device; see :class:`FrameSets`.

    Raises:
        RuntimeError: there is no such device, or it has no such streams.
    """

    def __init__(self, serial: str, options: StreamOptions) -> None:
        rs = _pyrealsense()
        if not len(rs.context().query_devices()):  # start() would wait for one for 15 s
            raise RuntimeError("No device connected")
        self._pipeline, config = rs.pipeline(), rs.config()
        if serial:
            config.enable_device(serial)
        for stream, kind in ((rs.stream.color, rs.format.rgb8), (rs.stream.depth, rs.format.z16)):
            config.enable_stream(stream, options.width, options.height, kind, round(options.fps))
        profile = self._pipeline.start(config)
        self.color = profile.get_stream(rs.stream.color)
        self.motion = next((s for s in profile.get_device().query_sensors() if s.is_motion_sensor()), None)

    def wait(self, milliseconds: int) -> Any:
        """Implement :meth:`FrameSets.wait`."""
        came, pair = self._pipeline.try_wait_for_frames(milliseconds)
        return pair if came and pair.get_color_frame() and pair.get_depth_frame() else None

    def stop(self) -> None:
        """End the streams."""
        self._pipeline.stop()


def _number_of(pair: Any) -> int:
    return int(pair.get_color_frame().get_frame_number())


def _pyrealsense() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        hint = "install the extra: pip install 'splatbot[realsense]'"
        raise DeviceError(f"needs pyrealsense2 ({error}).", file=PREFIX, field="camera", hint=hint) from error
    return pyrealsense2
