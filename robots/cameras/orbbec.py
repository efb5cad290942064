"""Orbbec cameras with pyorbbecsdk 2 (extra `orbbec`): colour, and depth that the library aligns to it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from splatbot.camera import Camera
from splatbot.errors import DeviceError
from splatbot.frame import Frame
from splatbot.layouts import ORBBEC as PREFIX
from splatbot.robots.cameras.device import CONSTANTS as DEVICE
from splatbot.robots.cameras.device import RgbdDevice
from splatbot.robots.cameras.stream_options import StreamOptions, parse_address

DEFAULT = StreamOptions(width=640, height=480)

_MILLIMETRE = 0.001  # [m] unit of the depth scale of the library
_MICROSECOND = 1e-6  # [s] unit of its stamps


class OrbbecCamera(RgbdDevice):
    """An Orbbec camera as a source of frames; each iteration opens the device.

    Stamps are Unix time. If the device has no global clock, its own is shifted to Unix time by the first image.

    Args:
        serial: serial number; empty takes the first device.
        options: requested streams. The size is that of colour; depth is aligned to it.

    Raises:
        DeviceError: when iterating: pyorbbecsdk2 is missing, there is no device, or it is gone.
    """

    def __init__(self, serial: str = "", options: StreamOptions = DEFAULT) -> None:
        super().__init__(PREFIX, serial, options)

    @classmethod
    def from_uri(cls, uri: str) -> OrbbecCamera:
        """Return the camera of `orbbec://SERIAL?size=640x480&fps=30`; all parts after `orbbec://` may be missing.

        Raises:
            InputError: an option is unknown or out of range.
        """
        return cls(*parse_address(uri, PREFIX, DEFAULT))

    def __iter__(self) -> Iterator[Frame]:
        ob = _pyorbbecsdk()
        if self._closed.is_set():
            return
        try:
            pipeline, has_clock = self._start(ob)
        except (ob.OBError, RuntimeError) as error:
            hint = (
                "plug it into a USB 3 port, and check its sizes and rates with OrbbecViewer. Linux needs its udev rules"
            )
            raise self._cannot_be_opened(error, hint) from error
        align = ob.AlignFilter(align_to_stream=ob.OBStreamType.COLOR_STREAM)

        def wait() -> Any:
            try:
                images = pipeline.wait_for_frames(round(1e3 * DEVICE.poll_s))
                if images is None or images.get_color_frame() is None or images.get_depth_frame() is None:
                    return None
                return align.process(images)
            except ob.OBError as error:
                raise RuntimeError(str(error)) from error

        try:
            shift: int | None = 0 if has_clock else None  # [us] from the clock of the stamps to Unix time
            for pair in self._pairs(wait, lambda pair: int(pair.get_color_frame().get_index())):
                color, depth = pair.get_color_frame(), pair.get_depth_frame()
                at, depth_at = (_stamp(image, has_clock) for image in (color, depth))
                if shift is None:
                    shift = color.get_system_timestamp_us() - at
                rgb, metres = self._images(ob, color, depth)
                camera, delay = self._color_camera(ob, color), _MICROSECOND * (depth_at - at)
                yield self._next_frame(_MICROSECOND * (at + shift), rgb, metres, camera, delay)
        finally:
            pipeline.stop()

    def _start(self, ob: Any) -> tuple[Any, bool]:
        """Start both streams, and return the pipeline and whether the stamps have a global clock."""
        ob.Context.set_logger_to_file(ob.OBLogLevel.NONE, "")  # otherwise it writes a folder "Log" where it is started
        devices = ob.Context().query_devices()
        if not devices.get_count():
            raise RuntimeError("no device is connected")
        by_serial, first = devices.get_device_by_serial_number, devices.get_device_by_index
        device = by_serial(self._serial) if self._serial else first(0)
        has_clock = bool(device.is_global_timestamp_supported())
        if has_clock:
            device.enable_global_timestamp(True)
        config, rate = ob.Config(), round(self.options.fps)
        size = self.options.width, self.options.height
        config.enable_video_stream(ob.OBStreamType.COLOR_STREAM, *size, rate, ob.OBFormat.RGB)
        config.enable_video_stream(ob.OBStreamType.DEPTH_STREAM, 0, 0, rate, ob.OBFormat.Y16)
        config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
        pipeline = ob.Pipeline(device)
        pipeline.start(config)
        return pipeline, has_clock

    def _images(self, ob: Any, color: Any, depth: Any) -> tuple[Any, Any]:
        """Return colour (H, W, 3) and depth (H, W) [m], copied from the buffers of the library.

        Raises:
            DeviceError: they have another format, or differ in size.
        """
        sizes = [(image.get_height(), image.get_width()) for image in (color, depth)]
        formats = [image.get_format() for image in (color, depth)]
        if formats != [ob.OBFormat.RGB, ob.OBFormat.Y16] or sizes[0] != sizes[1]:
            raise self._wrong(f"colour is {formats[0]} {sizes[0]}, depth is {formats[1]} {sizes[1]} (rows, columns)")
        rgb = np.frombuffer(color.get_data(), np.uint8).reshape(*sizes[0], 3).copy()
        units = np.frombuffer(depth.get_data(), np.uint16).reshape(sizes[1])
        return rgb, units.astype(np.float32) * np.float32(depth.get_depth_scale() * _MILLIMETRE)

    def _color_camera(self, ob: Any, color: Any) -> Camera:
        """Return the camera of colour, whose lens model is OpenCV's."""
        profile = color.get_stream_profile().as_video_stream_profile()
        i, d, models = profile.get_intrinsic(), profile.get_distortion(), ob.OBCameraDistortionModel
        lens = tuple(float(value) for value in (d.k1, d.k2, d.p1, d.p2, d.k3, d.k4, d.k5, d.k6))
        if any(lens) and d.model not in (models.BROWN_CONRADY, models.BROWN_CONRADY_K6):
            raise self._wrong(f"colour has the lens model {d.model}")
        kept = lens if any(lens[5:]) else lens[:5]
        return self._camera(i.fx, i.fy, i.cx, i.cy, size=(i.width, i.height), distortion=kept)


def _stamp(image: Any, has_clock: bool) -> int:
    """Return the stamp [us] of an image in the global clock, or in that of the device."""
    return int(image.get_global_timestamp_us() if has_clock else image.get_timestamp_us())


def _pyorbbecsdk() -> Any:
    try:
        import pyorbbecsdk
    except ImportError as error:
        hint = "install the extra: pip install 'splatbot[orbbec]'"
        raise DeviceError(f"needs pyorbbecsdk2 ({error}).", file=PREFIX, field="camera", hint=hint) from error
    return pyorbbecsdk
