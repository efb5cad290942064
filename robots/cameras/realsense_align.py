"""Test of this build of librealsense: it aligns depth to colour with the lens of colour, or without."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

_SIDE, _FOCAL, _AT = 128, 128.0, 96  # [px] of the square images, and the column of the only depth pixel
_COEFFICIENT = 1.0  # of the cube of the radius or of the angle; it moves the pixel by 8 px and more
_DEPTH = 1000
_TRIES, _WAIT_MS = 20, 100


@functools.cache
def aligns_with_lens(model: Any) -> bool:
    """Return whether ``rs.align`` puts depth at the distorted pixels of colour with a lens of a model.

    It depends on the processor: the code for SSE (2.59 and earlier) leaves out all lenses but "modified Brown-Conrady",
    and the code for others does not. One depth pixel of a software device shows which it is.

    Args:
        model: a value of ``rs.distortion`` whose first coefficient is radial.

    Raises:
        RuntimeError: the software device delivers no images.
    """
    import pyrealsense2 as rs

    device, pairs, sensors = rs.software_device(), rs.syncer(), []
    for stream, kind, bytes_each, lens in (
        (rs.stream.depth, rs.format.z16, 2, rs.distortion.none),
        (rs.stream.color, rs.format.rgb8, 3, model),
    ):
        video = rs.video_stream()
        video.type, video.index, video.uid, video.fmt, video.bpp = stream, 0, bytes_each, kind, bytes_each
        video.width, video.height, video.fps, video.intrinsics = _SIDE, _SIDE, 30, _intrinsics(rs, lens)
        sensor = device.add_sensor(stream.name)
        sensors.append((sensor, sensor.add_video_stream(video), bytes_each))
    here = rs.extrinsics()
    here.rotation, here.translation = np.eye(3).ravel().tolist(), [0.0, 0.0, 0.0]
    sensors[0][1].register_extrinsics_to(sensors[1][1], here)
    device.create_matcher(rs.matchers.default)
    for sensor, profile, _ in sensors:
        sensor.open(profile)
        sensor.start(pairs)
    try:
        for number in range(_TRIES):
            for sensor, profile, bytes_each in sensors:
                sensor.on_video_frame(_image(rs, number, profile, bytes_each))
            came, pair = pairs.try_wait_for_frames(_WAIT_MS)
            if came and pair.get_color_frame() and pair.get_depth_frame():
                aligned = np.asanyarray(rs.align(rs.stream.color).process(pair).get_depth_frame().get_data())
                if (columns := np.flatnonzero(aligned.any(axis=0))).size:
                    return bool(np.abs(columns - _AT).min() > 2)
    finally:
        for sensor, _, _ in sensors:
            sensor.stop()
            sensor.close()
    raise RuntimeError("librealsense's software device delivers no images")


def _intrinsics(rs: Any, model: Any) -> Any:
    made = rs.intrinsics()
    made.width = made.height = _SIDE
    made.fx = made.fy = _FOCAL
    made.ppx = made.ppy = _SIDE / 4
    made.model, made.coeffs = model, [_COEFFICIENT, 0.0, 0.0, 0.0, 0.0]
    return made


def _image(rs: Any, number: int, profile: Any, bytes_each: int) -> Any:
    """Return a black image, or depth of a single pixel in the row of the principal point."""
    frame = rs.software_video_frame()
    pixels = np.zeros((_SIDE, _SIDE, bytes_each), np.uint8)
    if bytes_each == 2:
        pixels.view(np.uint16)[_SIDE // 4, _AT] = _DEPTH
        frame.depth_units = 0.001
    frame.stride, frame.bpp, frame.pixels = _SIDE * bytes_each, bytes_each, pixels
    frame.timestamp, frame.domain, frame.frame_number = number * 33.0, rs.timestamp_domain.hardware_clock, number + 1
    frame.profile = profile.as_video_stream_profile()
    return frame
