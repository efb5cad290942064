"""RealSense cameras: librealsense's software device is the other side of the driver."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice, pairwise
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import DeviceError, InputError
from splatbot.frame import Frame
from splatbot.geometry import so3_exp
from splatbot.protocols import Array
from splatbot.robots.cameras import RealsenseCamera, device, open_camera
from splatbot.robots.cameras.stream_options import StreamOptions

rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 (extra realsense) is not installed")

WIDTH, HEIGHT, UNITS = 160, 120, 0.00025  # [m] a depth unit that is not a millimetre
NO_LENS = (0.0,) * 5


def intrinsics(fx: float, model: Any, coefficients: tuple[float, ...]) -> Any:
    """Return intrinsics of librealsense."""
    made = rs.intrinsics()
    made.width, made.height, made.fx, made.fy, made.ppx, made.ppy = WIDTH, HEIGHT, fx, fx + 1, 80.5, 58.0
    made.model, made.coeffs = model, list(coefficients)
    return made


@dataclass
class Imu:
    """A motion sensor of a software device; each sample holds its own time [s] in its first component.

    Args:
        domain: clock of the stamps.
        R: (3, 3) axes of the sensors in those of colour; None where they are not known.
        rates: [Hz] of the gyroscope and the accelerometer; 0 leaves one out.
    """

    domain: Any = None
    R: Array | None = field(default_factory=lambda: so3_exp([0.4, -1.1, 0.6]))
    rates: tuple[int, int] = (200, 100)
    sent: dict[Any, int] = field(default_factory=dict)

    def add_to(self, device: Any, color: Any) -> Any:
        """Return the sensor, which a driver may open."""
        self._sensor, self._profiles = device.add_sensor("Motion Module"), []
        for uid, (stream, rate) in enumerate(zip((rs.stream.gyro, rs.stream.accel), self.rates, strict=True), 5):
            for other in (2 * rate, rate) if rate else ():  # D400 offer several rates
                motion = rs.motion_stream()
                motion.type, motion.index, motion.uid, motion.fps = stream, 0, 10 * uid + (other > rate), other
                motion.fmt, motion.intrinsics = rs.format.motion_xyz32f, rs.motion_device_intrinsic()
                profile = self._sensor.add_motion_stream(motion)
                if self.R is not None:
                    turn = rs.extrinsics()
                    turn.rotation, turn.translation = self.R.T.ravel().tolist(), [0.1, 0.2, 0.3]
                    np.testing.assert_allclose(  # librealsense itself turns by these columns
                        rs.rs2_transform_point_to_point(turn, [1.0, 2.0, 3.0]),
                        self.R @ [1, 2, 3] + [0.1, 0.2, 0.3],
                        atol=1e-6,
                    )
                    profile.register_extrinsics_to(color, turn)
            if rate:
                self._profiles.append((stream, profile, rate))
        return self._sensor

    def send(self, until: float) -> None:
        """Send the samples up to a time [s]."""
        for stream, profile, rate in self._profiles:
            while (number := self.sent.get(stream, 0)) / rate <= until:
                frame, vector = rs.software_motion_frame(), rs.vector()
                vector.x, vector.y, vector.z = number / rate, -1.0, 0.5 if stream == rs.stream.gyro else 2.0
                frame.data, frame.timestamp, frame.frame_number = vector, 1000 * number / rate, number
                frame.domain = self.domain or rs.timestamp_domain.hardware_clock
                frame.profile = profile.as_motion_stream_profile()
                self._sensor.on_motion_frame(frame)
                self.sent[stream] = number + 1


class SoftwareStreams:
    """Streams of a software device that sends images of colour and depth from a thread."""

    def __init__(
        self,
        images: list[tuple[NDArray[np.uint8], NDArray[np.uint16]]],
        *,
        lens: tuple[float, ...] = NO_LENS,
        model: str = "inverse_brown_conrady",
        baseline: float = 0.0,
        domain: Any = None,
        unix_from: int | None = None,
        missing: tuple[int, ...] = (),
        imu: Imu | None = None,
    ) -> None:
        self._images, self._missing, self._imu, self._unix_from = images, missing, imu, unix_from
        self._domain = domain or rs.timestamp_domain.hardware_clock
        self._device = rs.software_device()
        self._profiles = []
        for name, stream, kind, size, lenses in (
            ("Stereo Module", rs.stream.depth, rs.format.z16, 2, NO_LENS),
            ("RGB Camera", rs.stream.color, rs.format.rgb8, 3, lens),
        ):
            sensor = self._device.add_sensor(name)
            video = rs.video_stream()
            video.type, video.index, video.uid, video.fmt, video.bpp = stream, 0, size - 2, kind, size
            video.width, video.height, video.fps = WIDTH, HEIGHT, 30
            kind_of_lens = getattr(rs.distortion, model if size == 3 else "none")
            video.intrinsics = intrinsics(140.0 if size == 3 else 130.0, kind_of_lens, lenses)
            self._profiles.append((sensor, sensor.add_video_stream(video), size))
        moved = rs.extrinsics()
        moved.rotation, moved.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [baseline, 0, 0]
        self._profiles[0][1].register_extrinsics_to(self._profiles[1][1], moved)
        self.color = self._profiles[1][1]
        self.motion = None if imu is None else imu.add_to(self._device, self.color)
        self._device.create_matcher(rs.matchers.default)
        self._pairs = rs.syncer(16)
        for sensor, profile, _ in self._profiles:
            sensor.open(profile)
            sensor.start(self._pairs)
        self._sender = threading.Thread(target=self._send, daemon=True)

    def _send(self) -> None:
        for number, images in enumerate(self._images, 1):
            if self._imu is not None:
                self._imu.send(until=number / 30)
            if number in self._missing:
                continue
            for (sensor, profile, size), pixels in zip(self._profiles, reversed(images), strict=True):
                frame = rs.software_video_frame()
                frame.stride, frame.bpp, frame.pixels = WIDTH * size, size, np.ascontiguousarray(pixels)
                frame.timestamp = 1000 * (number - 1) / 30  # the matcher of software devices needs stamps from 0
                frame.domain, frame.frame_number = self._domain, number
                if self._unix_from is not None and number >= self._unix_from:
                    frame.domain = rs.timestamp_domain.global_time
                frame.profile = profile.as_video_stream_profile()
                if size == 2:
                    frame.depth_units = UNITS
                sensor.on_video_frame(frame)
            time.sleep(0.0301)

    def wait(self, milliseconds: int) -> Any:
        if not self._sender.ident:  # the driver has opened all streams: none misses the first samples
            self._sender.start()
        came, pair = self._pairs.try_wait_for_frames(milliseconds)
        return pair if came and pair.get_color_frame() and pair.get_depth_frame() else None

    def stop(self) -> None:
        for sensor, _, _ in self._profiles:
            sensor.stop()
            sensor.close()


def scene(count: int) -> list[tuple[NDArray[np.uint8], NDArray[np.uint16]]]:
    """Return images of a plane at 0.6 m with a smooth texture that differs by frame."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    flat = np.full((HEIGHT, WIDTH), round(0.6 / UNITS), np.uint16)
    waves = [(127 + 120 * np.sin(u / 9 + k), 127 + 120 * np.cos(v / 7), (u + v) / 2) for k in range(count)]
    return [(np.stack(np.broadcast_arrays(*wave), axis=2).astype(np.uint8), flat) for wave in waves]


def opened(make: Callable[[], SoftwareStreams]) -> RealsenseCamera:
    """Return a camera of a software device."""
    return RealsenseCamera(open_streams=lambda _serial, _options: make())


def seen(camera: RealsenseCamera, count: int) -> list[Frame]:
    """Return frames of a camera, which is then closed."""
    frames = list(islice(iter(camera), count))
    camera.close()
    return frames


def test_frames_have_pixels_units_intrinsics_and_stamps_of_the_device() -> None:
    images = scene(6)
    frames = seen(opened(lambda: SoftwareStreams(images)), 3)
    for frame in frames:
        k = next(k for k, (rgb, _) in enumerate(images) if (rgb == frame.rgb).all())
        assert frame.stamp - frames[0].stamp == pytest.approx((k - _first(images, frames)) / 30, abs=1e-6)
        inner = frame.depth[30:-30, 30:-30]
        np.testing.assert_allclose(inner[inner > 0], 0.6, rtol=1e-6)
        assert (inner > 0).all()
        assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == (140.0, 141.0, 80.5, 58.0)
        assert frame.depth_delay == 0.0
    assert abs(frames[0].stamp - time.time()) < 3.0


def _first(images: list[tuple[NDArray[np.uint8], NDArray[np.uint16]]], frames: list[Frame]) -> int:
    return next(k for k, (rgb, _) in enumerate(images) if (rgb == frames[0].rgb).all())


def test_stamps_in_system_time_are_kept() -> None:
    (frame,) = seen(opened(lambda: SoftwareStreams(scene(4), domain=rs.timestamp_domain.system_time)), 1)
    assert 0.0 <= frame.stamp < 1.0


def test_stamps_that_change_to_unix_time_are_not_shifted_any_more() -> None:
    frames = seen(opened(lambda: SoftwareStreams(scene(12), unix_from=5)), 8)
    assert abs(frames[0].stamp - time.time()) < 3.0
    assert 0.0 < frames[-1].stamp < 1.0  # Unix time of the software device


def test_depth_is_registered_to_colour_over_the_baseline() -> None:
    def step() -> list[tuple[NDArray[np.uint8], NDArray[np.uint16]]]:
        near = np.full((HEIGHT, WIDTH), round(0.5 / UNITS), np.uint16)
        near[:, WIDTH // 2 :] = round(1.0 / UNITS)
        return [(rgb, near) for rgb, _ in scene(4)]

    (frame,) = seen(opened(lambda: SoftwareStreams(step(), baseline=0.05)), 1)
    # A point at depth column 79, 0.5 m away, is at x = (79 - 80.5) / 130 * 0.5 + 0.05 m in the frame of colour.
    edge = ((79 - 80.5) / 130 * 0.5 + 0.05) / 0.5 * 140 + 80.5
    row = frame.depth[60]
    assert np.flatnonzero(np.isclose(row, 0.5, atol=1e-3)).max() == pytest.approx(edge, abs=1.5)


def test_a_distorted_lens_is_undone_as_librealsense_defines_it() -> None:
    lens = (0.08, -0.03, 0.004, -0.003, 0.01)
    rgb = scene(1)[0][0]
    (frame,) = seen(opened(lambda: SoftwareStreams(scene(1) * 4, lens=lens)), 1)
    given = intrinsics(140.0, rs.distortion.inverse_brown_conrady, lens)
    errors = []
    for v in range(10, HEIGHT - 10, 7):
        for u in range(10, WIDTH - 10, 7):  # the ray of a recorded pixel, by librealsense, and its undistorted pixel
            x, y, _ = rs.rs2_deproject_pixel_to_point(given, [float(u), float(v)], 1.0)
            at = np.array([x * 140.0 + 80.5, y * 141.0 + 58.0])
            if (at < 4).any() or at[0] > WIDTH - 5 or at[1] > HEIGHT - 5:
                continue
            low = np.floor(at).astype(int)
            a, b = at - low
            patch = frame.rgb[low[1] : low[1] + 2, low[0] : low[0] + 2].astype(float)
            value = (1 - b) * ((1 - a) * patch[0, 0] + a * patch[0, 1]) + b * ((1 - a) * patch[1, 0] + a * patch[1, 1])
            errors.append(np.abs(value - rgb[v, u]).max())
    assert len(errors) > 100
    assert max(errors) < 4.0
    assert not frame.camera.distortion


def pattern(u: Array, v: Array) -> Array:
    """Return colours (..., 3) that change smoothly with the pixel."""
    return 128 + np.stack([100 * np.sin(u / 9), 100 * np.cos(v / 8), 90 * np.sin((u + v) / 11)], -1)


BROWN = (0.3, -0.2, 0.02, -0.015, 0.05)


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("brown_conrady", BROWN),
        ("modified_brown_conrady", BROWN),
        ("inverse_brown_conrady", BROWN),
        ("kannala_brandt4", (0.05, -0.02, 0.01, -0.003, 0.0)),
    ],
)
def test_each_lens_is_undone_as_librealsense_projects_and_depth_is_at_the_same_pixels(
    model: str, lens: tuple[float, ...]
) -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    rgb = np.rint(pattern(u, v)).astype(np.uint8)
    slope = 0.01  # of depth [m] a pixel
    metres = 0.5 + slope * u
    images = [(rgb, np.rint(metres / UNITS).astype(np.uint16))] * 4
    (frame,) = seen(opened(lambda: SoftwareStreams(images, lens=lens, model=model)), 1)
    x, y = (u - 80.5) / 140, (v - 58) / 141
    given = intrinsics(140.0, getattr(rs.distortion, model), lens)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    at = np.array([rs.rs2_project_point_to_pixel(given, ray) for ray in rays.tolist()]).reshape(HEIGHT, WIDTH, 2)
    if model in ("brown_conrady", "kannala_brandt4"):
        fisheye = model == "kannala_brandt4"
        K, known = np.array([[140.0, 0, 80.5], [0, 141, 58], [0, 0, 1]]), np.array(lens[:4] if fisheye else lens)
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        by_opencv = project(rays[:, None], np.zeros(3), np.zeros(3), K, known)[0]
        np.testing.assert_allclose(at.reshape(-1, 2), np.reshape(by_opencv, (-1, 2)), atol=1e-3)
    assert np.abs(at - np.stack([u, v], -1)).max() > 4
    inner = (at > 1).all(-1) & (at[..., 0] < WIDTH - 2) & (at[..., 1] < HEIGHT - 2)
    assert inner.mean() > 0.6
    np.testing.assert_allclose(frame.rgb[inner], pattern(*np.moveaxis(at, -1, 0))[inner], atol=2.5)
    seen_by_both = inner & (frame.depth > 0)
    assert seen_by_both.mean() > 0.5
    wanted = 0.5 + slope * (80.5 + 130 * x)  # the depth camera is at the same place, and has no lens
    np.testing.assert_allclose(frame.depth[seen_by_both], wanted[seen_by_both], atol=2 * slope)  # the nearest wins
    assert not frame.camera.distortion


@pytest.mark.parametrize(
    ("model", "lens", "problem"),
    [
        ("ftheta", (0.9, 0.0, 0.0, 0.0, 0.0), "colour with a lens of the model ftheta.*ROS driver"),
        ("brown_conrady", (-30.0, 0.0, 0.0, 0.0, 0.0), "a lens that folds the image.*calibrate it"),
    ],
)
def test_a_lens_that_cannot_be_rectified_is_refused_with_its_model_and_a_fix(
    model: str, lens: tuple[float, ...], problem: str
) -> None:
    with pytest.raises(DeviceError, match=problem) as caught:
        seen(opened(lambda: SoftwareStreams(scene(4), lens=lens, model=model)), 1)
    assert caught.value.file == "realsense://"


def rows_of(frames: list[Frame], name: str) -> Array:
    return np.concatenate([getattr(frame.imu, name) for frame in frames])


@pytest.mark.parametrize("domain", ["hardware_clock", "system_time"])
def test_samples_have_the_clock_and_axes_of_colour_and_each_sensor_its_own_rate(domain: str) -> None:
    clock = getattr(rs.timestamp_domain, domain)
    imu = Imu(domain=clock)
    frames = seen(opened(lambda: SoftwareStreams(scene(20), domain=clock, imu=imu)), 8)
    assert imu.R is not None
    for name, period, z in (("gyroscope", 1 / 200, 0.5), ("accelerometer", 1 / 100, 2.0)):
        rows = rows_of(frames, name)
        assert len(rows) > 4 / 30 / period
        np.testing.assert_allclose(np.diff(rows[:, 0]), period, atol=2e-6)  # no sample is lost or repeated
        vectors = rows[:, 1:] @ imu.R  # in the axes of the sensor
        np.testing.assert_allclose(vectors[:, 1:], np.tile([-1.0, z], (len(rows), 1)), atol=1e-6)
        shift = rows[0, 0] - vectors[0, 0]  # from the clock of the device to that of the frames
        number = 30 * (frames[0].stamp - shift)
        assert number == pytest.approx(round(number), abs=1e-3)  # images are sent at multiples of 1/30 s
        assert (abs(shift) < 1e-6) == (domain == "system_time")
    for earlier, later in pairwise(frames):
        assert later.imu is not None
        assert (later.imu.gyro_stamps <= later.stamp).all()
        assert (later.imu.gyro_stamps > earlier.stamp).sum() >= 5


def test_a_device_with_a_gyroscope_alone_delivers_rates_alone() -> None:
    frames = seen(opened(lambda: SoftwareStreams(scene(20), imu=Imu(rates=(400, 0)))), 5)
    assert len(rows_of(frames, "gyroscope")) > 10
    assert not len(rows_of(frames, "accelerometer"))


@pytest.mark.parametrize(
    ("imu", "problem"),
    [
        (Imu(R=None), "Requested extrinsics are not available"),
        (Imu(R=np.zeros((3, 3))), "the matrix of its axes is no rotation"),
        (Imu(rates=(0, 100)), "it has no gyroscope"),
    ],
)
def test_an_imu_that_cannot_be_used_is_left_out_with_its_reason(
    imu: Imu, problem: str, caplog: pytest.LogCaptureFixture
) -> None:
    (frame,) = seen(opened(lambda: SoftwareStreams(scene(4), imu=imu)), 1)
    assert frame.imu is None
    assert f"the IMU of realsense:// is not used: {problem}" in caplog.text


def test_samples_of_another_clock_than_the_images_are_left_out_with_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    imu = Imu(domain=rs.timestamp_domain.hardware_clock)
    frames = seen(opened(lambda: SoftwareStreams(scene(9), domain=rs.timestamp_domain.global_time, imu=imu)), 4)
    assert not len(rows_of(frames, "gyroscope"))
    assert caplog.text.count("stamps are of the device clock") == 1


def test_lost_images_are_counted_and_a_silent_device_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "CONSTANTS", device.RgbdDeviceConstants(silence_s=0.5))
    camera = opened(lambda: SoftwareStreams(scene(8), missing=(4, 5)))
    after_lost = SimpleNamespace(monotonic=lambda: time.monotonic() if camera.dropped else 0.0)
    monkeypatch.setattr(device, "time", after_lost)  # the silence begins after the images that follow the lost ones
    with pytest.raises(DeviceError, match="is gone"):
        list(camera)
    assert camera.dropped == 2


def test_without_a_device_one_sentence_names_the_fix() -> None:
    with pytest.raises(DeviceError, match="USB 3"):
        next(iter(open_camera("realsense://")))


def test_addresses_name_serial_size_and_rate() -> None:
    camera = RealsenseCamera.from_uri("realsense://834412070000?size=848x480&fps=60")
    assert camera.options == StreamOptions(848, 480, 60.0)
    with pytest.raises(InputError, match="sixty"):
        open_camera("realsense://?fps=sixty")
