"""Orbbec cameras with pyorbbecsdk 2 (extra `orbbec`): colour, and depth that the library aligns to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from splatbot.errors import DeviceError
from splatbot.frame import Frame
from splatbot.layouts import ORBBEC as PREFIX
from splatbot.robots.cameras.device import CONSTANTS as DEVICE
from splatbot.robots.cameras.device import ImageLens, RgbdDevice
from splatbot.robots.cameras.orbbec_imu import MICROSECOND, OrbbecImu, open_imu, stamp_of
from splatbot.robots.cameras.stream_options import StreamOptions, parse_address

DEFAULT = StreamOptions(width=640, height=480)

_MILLIMETRE = 0.001  # [m] unit of the depth scale of the library


class OrbbecCamera(RgbdDevice):
    """An Orbbec camera as a source of frames; each iteration opens the device.

    Stamps are Unix time. If the device has no global clock, its own is shifted to Unix time by the first image. Frames
    have the samples of the IMU, if there is one.

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
            pipeline, imu, has_clock = self._start(ob)
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
                at, depth_at = (stamp_of(image, has_clock=has_clock) for image in (color, depth))
                if shift is None:
                    shift = color.get_system_timestamp_us() - at
                rgb, metres = self._images(ob, color, depth)
                lenses = self._lens(ob, color, color, "colour"), self._lens(ob, color, depth, "depth")
                stamp, delay = MICROSECOND * (at + shift), MICROSECOND * (depth_at - at)
                frame = self._next_frame(stamp, rgb, metres, lenses, delay)
                yield frame if imu is None else replace(frame, imu=imu.until(stamp, MICROSECOND * shift))
        finally:
            if imu is not None:
                imu.stop()
            pipeline.stop()

    def _start(self, ob: Any) -> tuple[Any, OrbbecImu | None, bool]:
        """Start all streams, and return pipeline, IMU if there is one, and whether stamps have a global clock."""
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
        profile = pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR).get_default_video_stream_profile()
        return pipeline, open_imu(ob, device, profile, self.uri, has_clock=has_clock), has_clock

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

    def _lens(self, ob: Any, color: Any, image: Any, name: str) -> ImageLens:
        """Return the lens of an image by its own stream profile, with the pixels of colour.

        The library aligns depth to the pixels of colour without its distortion, unless "TargetDistortion" is set.

        Raises:
            DeviceError: the lens is of another model, or makes no sense.
        """
        i = color.get_stream_profile().as_video_stream_profile().get_intrinsic()
        d = image.get_stream_profile().as_video_stream_profile().get_distortion()
        models, radial = ob.OBCameraDistortionModel, (d.k1, d.k2, d.p1, d.p2, d.k3)
        known = {
            models.NONE: (),
            models.BROWN_CONRADY: radial,
            models.BROWN_CONRADY_K6: (*radial, d.k4, d.k5, d.k6),
            models.KANNALA_BRANDT4: (d.k1, d.k2, d.k3, d.k4),
        }
        if any((*radial, d.k4, d.k5, d.k6)) and d.model not in known:
            raise self._unknown_lens(d.model.name, name)
        lens = tuple(float(value) for value in known.get(d.model, ()))
        fisheye = d.model == models.KANNALA_BRANDT4
        size = (i.width, i.height)
        return ImageLens(self._camera(i.fx, i.fy, i.cx, i.cy, size=size, distortion=lens, fisheye=fisheye))


def _pyorbbecsdk() -> Any:
    try:
        import pyorbbecsdk
    except ImportError as error:
        hint = "install the extra: pip install 'splatbot[orbbec]'"
        raise DeviceError(f"needs pyorbbecsdk2 ({error}).", file=PREFIX, field="camera", hint=hint) from error
    return pyorbbecsdk
