"""RealSense cameras with pyrealsense2 (extra `realsense`): colour, and depth that librealsense aligns to it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, DeviceError
from splatbot.frame import Frame
from splatbot.logs.undistort import Undistorter
from splatbot.robots.cameras.stream_options import StreamOptions, parse_address

PREFIX = "realsense://"
DEFAULT = StreamOptions(width=640, height=480)


@dataclass(frozen=True)
class RealsenseConstants:
    """Constants of the RealSense driver.

    Args:
        silence_s: [s] time without a pair after which the device counts as gone.
        poll_ms: [ms] time between two looks at whether the camera was closed.
    """

    silence_s: float = 10.0
    poll_ms: int = 200


CONSTANTS = RealsenseConstants()


class FrameSets(Protocol):
    """Synchronized images of a device."""

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


class RealsenseCamera:
    """A RealSense camera as a source of frames; each iteration opens the device.

    Stamps of librealsense in global or system time are Unix time. Those of the device's own clock are shifted to Unix
    time by the first image.

    Attributes:
        dropped: images of colour without a pair here: a slow reader or the transfer lost them.

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
        self.name = "realsense" + (f"-{serial}" if serial else "")
        self.uri = PREFIX + serial
        self.options = options
        self.dropped = 0
        self._serial, self._open = serial, open_streams or DeviceStreams
        self._closed = threading.Event()
        self._number = 0

    @classmethod
    def from_uri(cls, uri: str) -> RealsenseCamera:
        """Return the camera of `realsense://SERIAL?size=640x480&fps=30`; all parts after `realsense://` may be missing.

        Raises:
            InputError: an option is unknown or out of range.
        """
        return cls(*parse_address(uri, PREFIX, DEFAULT))

    def close(self) -> None:
        """End the stream."""
        self._closed.set()

    def __iter__(self) -> Iterator[Frame]:
        rs = _pyrealsense()
        if self._closed.is_set():
            return
        try:
            streams = self._open(self._serial, self.options)
        except RuntimeError as error:
            hint = "plug it into a USB 3 port; `rs-enumerate-devices` lists its sizes and rates, and its serial number"
            raise DeviceError(f"cannot be opened ({error}).", file=self.uri, field="camera", hint=hint) from error
        try:
            align = rs.align(rs.stream.color)
            last: int | None = None
            shift: float | None = None
            lens: _Lens | None = None
            for pair in self._pairs(streams):
                aligned = align.process(pair)
                color, depth = aligned.get_color_frame(), aligned.get_depth_frame()
                self.dropped += max(color.get_frame_number() - last - 1, 0) if last is not None else 0
                last = color.get_frame_number()
                if shift is None:
                    own = color.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock
                    shift = time.time() - 1e-3 * color.get_timestamp() if own else 0.0
                lens = lens or _Lens(rs, color.profile.as_video_stream_profile().intrinsics, self.uri)
                stamp = 1e-3 * color.get_timestamp()
                one_clock = color.get_frame_timestamp_domain() == depth.get_frame_timestamp_domain()
                metres = np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(depth.get_units())
                yield Frame(
                    stamp=shift + stamp,
                    rgb=lens.color(np.asanyarray(color.get_data())),
                    depth=lens.depth(metres),
                    camera=lens.camera,
                    index=self._number,
                    source=f"{self.uri} frame {self._number}",
                    depth_delay=1e-3 * depth.get_timestamp() - stamp if one_clock else 0.0,
                )
                self._number += 1
        finally:
            streams.stop()

    def _pairs(self, streams: FrameSets) -> Iterator[Any]:
        """Yield sets with colour and depth until the camera is closed.

        Raises:
            DeviceError: the device is gone or silent.
        """
        heard = time.monotonic()
        while not self._closed.is_set():
            try:
                pair = streams.wait(CONSTANTS.poll_ms)
            except RuntimeError as error:
                raise self._gone(str(error)) from error
            if pair is not None:
                heard = time.monotonic()
                yield pair
            elif time.monotonic() - heard > CONSTANTS.silence_s:
                raise self._gone(f"no pair of colour and depth for {CONSTANTS.silence_s:g} s")

    def _gone(self, reason: str) -> DeviceError:
        return DeviceError(f"is gone ({reason}).", file=self.uri, field="camera", hint="check its cable and power")


class DeviceStreams:
    """The streams of a device; see :class:`FrameSets`.

    Raises:
        RuntimeError: there is no such device, or it has no such streams.
    """

    def __init__(self, serial: str, options: StreamOptions) -> None:
        rs = _pyrealsense()
        self._pipeline, config = rs.pipeline(), rs.config()
        if serial:
            config.enable_device(serial)
        for stream, kind in ((rs.stream.color, rs.format.rgb8), (rs.stream.depth, rs.format.z16)):
            config.enable_stream(stream, options.width, options.height, kind, round(options.fps))
        self._pipeline.start(config)

    def wait(self, milliseconds: int) -> Any:
        """Implement :meth:`FrameSets.wait`."""
        came, pair = self._pipeline.try_wait_for_frames(milliseconds)
        return pair if came and pair.get_color_frame() and pair.get_depth_frame() else None

    def stop(self) -> None:
        """End the streams."""
        self._pipeline.stop()


class _Lens:
    """Images of a RealSense colour camera as those of a pinhole camera with the same intrinsic matrix.

    "Brown-Conrady" is OpenCV's model. "Inverse Brown-Conrady" of librealsense 2.5x projects as OpenCV's does, but for
    a radial factor in the tangential terms. They are 1e-3 px apart with the lenses of these cameras.
    """

    def __init__(self, rs: Any, intrinsics: Any, uri: str) -> None:
        coefficients = tuple(float(value) for value in intrinsics.coeffs) if any(intrinsics.coeffs) else ()
        if coefficients and intrinsics.model not in (rs.distortion.inverse_brown_conrady, rs.distortion.brown_conrady):
            hint = "take another size of colour"
            raise DeviceError(f"has the lens model {intrinsics.model}.", file=uri, field="intrinsics", hint=hint)
        i = intrinsics
        try:
            recorded = Camera(i.fx, i.fy, i.ppx, i.ppy, i.width, i.height, coefficients)
            recorded.check_plausible()
        except CameraError as error:
            reason = f"{error.field} {error.message}"
            raise DeviceError(reason, file=uri, field="intrinsics", hint="calibrate the camera again") from error
        self.camera = replace(recorded, distortion=())
        self._undistorter = Undistorter(recorded) if coefficients else None

    def color(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return colour (H, W, 3) without distortion; the buffer of ``rgb`` belongs to librealsense."""
        return rgb.copy() if self._undistorter is None else self._undistorter.color(rgb)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth (H, W) [m] without distortion, of the nearest pixel."""
        return depth if self._undistorter is None else self._undistorter.depth(depth)


def _pyrealsense() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        hint = "install the extra: pip install 'splatbot[realsense]'"
        raise DeviceError(f"needs pyrealsense2 ({error}).", file=PREFIX, field="camera", hint=hint) from error
    return pyrealsense2
