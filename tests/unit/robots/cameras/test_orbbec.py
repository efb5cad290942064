"""Orbbec cameras: stand-ins of the classes of pyorbbecsdk2, by its stubs, are the other side of the driver."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from enum import IntEnum
from itertools import islice
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import DeviceError, InputError
from splatbot.frame import Frame
from splatbot.geometry import so3_exp
from splatbot.protocols import Array
from splatbot.robots.cameras import OrbbecCamera, device, open_camera
from splatbot.robots.cameras.stream_options import StreamOptions

WIDTH, HEIGHT = 96, 72
DEVICE_EPOCH = 5_000_000  # [us] stamp of image 0 in the clock of the device


class OBError(Exception):
    """The exception of the library."""


class LensModel(IntEnum):
    """OBCameraDistortionModel with the values of pyorbbecsdk2 2.1."""

    NONE = 0
    MODIFIED_BROWN_CONRADY = 1
    INVERSE_BROWN_CONRADY = 2
    BROWN_CONRADY = 3
    BROWN_CONRADY_K6 = 4
    KANNALA_BRANDT4 = 5


class Image:
    """A frame of the library: bytes, and get methods for all else."""

    def __init__(self, number: int, pixels: NDArray[Any], kind: str, unix_us: int, lag_us: int, lens: Any) -> None:
        self._number, self._pixels, self._kind, self._lens = number, pixels, kind, lens
        self._unix, self._lag = unix_us, lag_us

    def get_index(self) -> int:
        return self._number

    def get_data(self) -> NDArray[np.uint8]:
        return np.frombuffer(self._pixels.tobytes(), np.uint8)

    def get_height(self) -> int:
        return int(self._pixels.shape[0])

    def get_width(self) -> int:
        return int(self._pixels.shape[1])

    def get_format(self) -> str:
        return self._kind

    def get_depth_scale(self) -> float:
        return 0.25  # [mm]

    def get_timestamp_us(self) -> int:
        return DEVICE_EPOCH + self._number * 33_333 + self._lag

    def get_global_timestamp_us(self) -> int:
        return self._unix + self._number * 33_333 + self._lag

    def get_system_timestamp_us(self) -> int:
        return self._unix + self._number * 33_333 + 12_000  # when it has arrived

    def get_stream_profile(self) -> Any:
        values = SimpleNamespace(fx=70.0, fy=71.0, cx=40.5, cy=29.0, width=WIDTH, height=HEIGHT)
        profile = SimpleNamespace(get_intrinsic=lambda: values, get_distortion=lambda: self._lens)
        return SimpleNamespace(as_video_stream_profile=lambda: profile)


class FrameSet:
    """Frames of one time."""

    def __init__(self, color: Image | None, depth: Image | None) -> None:
        self.get_color_frame, self.get_depth_frame = lambda: color, lambda: depth


class Sample:
    """A sample of a sensor; it holds its own time [s] since image 0 in its first component."""

    def __init__(self, unix_us: int, at_us: int, z: float) -> None:
        self.get_x, self.get_y, self.get_z = lambda: 1e-6 * at_us, lambda: -1.0, lambda: z
        self.get_timestamp_us = lambda: DEVICE_EPOCH + at_us
        self.get_global_timestamp_us = lambda: unix_us + at_us


class ImuPipeline:
    """A pipeline of the library that sends samples of 200 Hz, or of its default rate, from a thread of its own.

    Args:
        R: (3, 3) axes of the sensors in those of colour.
        rates: [Hz] that the device has.
    """

    def __init__(self, R: Array, rates: tuple[int, ...] = (200, 100)) -> None:
        self._R, self._rates, self._rate, self._sent = R, rates, 0, 0
        self.stopped = self.lost = False

    def get_stream_profile_list(self, kind: str) -> Any:
        assert kind in ("gyroscope", "accelerometer")
        profile = SimpleNamespace(get_extrinsic_to=self._extrinsic)
        return SimpleNamespace(get_stream_profile_by_index=lambda _: profile)

    def _extrinsic(self, color: str) -> Any:
        assert color == "colour profile"
        return SimpleNamespace(rot=self._R.astype(np.float32), transform=np.ones(3, np.float32))

    def start(self, config: Any, callback: Callable[[Any], None]) -> None:
        if config.rates["gyro"] not in self._rates:
            raise OBError("no matched gyro stream profile")
        assert config.mode == "each frame alone"
        self._rate, self._callback = config.rates["gyro"], callback

    def send_until(self, image: Image) -> None:
        """Send the samples up to 10 ms after an image from another thread, as the library does."""
        until = image.get_timestamp_us() - DEVICE_EPOCH + 10_000

        def send() -> None:
            while self._rate and (at := self._sent * 1_000_000 // self._rate) <= until:
                unix = image.get_global_timestamp_us() - (image.get_timestamp_us() - DEVICE_EPOCH)
                gyro, accel = Sample(unix, at, 0.5), Sample(unix, at + 1_000, 2.0)
                self._callback(SimpleNamespace(get_gyro_frame=lambda s=gyro: s, get_accel_frame=lambda: None))
                self._callback(SimpleNamespace(get_gyro_frame=lambda: None, get_accel_frame=lambda s=accel: s))
                self._sent += 1

        thread = threading.Thread(target=send)
        thread.start()
        thread.join()

    def stop(self) -> None:
        self.stopped = True
        if self.lost:
            raise OBError("device is gone")


class Contexts:
    """The class Context of the library, which finds one list of devices."""

    def __init__(self, devices: Any) -> None:
        self._devices = devices

    def __call__(self) -> Any:
        return SimpleNamespace(query_devices=lambda: self._devices)

    def set_logger_to_file(self, level: str, folder: str) -> None:
        assert level == "none"


class Library:
    """The module pyorbbecsdk with one device that sends frame sets and then is silent or lost."""

    OBError = OBError
    OBLogLevel = SimpleNamespace(NONE="none")
    OBStreamType = SimpleNamespace(COLOR_STREAM="colour stream", DEPTH_STREAM="depth stream")
    OBFormat = SimpleNamespace(RGB="RGB", Y16="Y16")
    OBFrameAggregateOutputMode = SimpleNamespace(FULL_FRAME_REQUIRE="full", DISABLE="each frame alone")
    OBSensorType = SimpleNamespace(COLOR_SENSOR="colour", GYRO_SENSOR="gyroscope", ACCEL_SENSOR="accelerometer")
    OBGyroSampleRate = SimpleNamespace(SAMPLE_RATE_200_HZ=200, SAMPLE_RATE_UNKNOWN=100)
    OBCameraDistortionModel = LensModel

    def __init__(
        self,
        sets: list[FrameSet | None],
        *,
        clock: bool = True,
        serials: tuple[str, ...] = ("A1",),
        imu: ImuPipeline | None = None,
    ) -> None:
        self._imu, self._pipelines = imu, iter([self, imu])
        self._sets, self._clock, self._serials = iter(sets), clock, serials
        self.Context = Contexts(self)
        self.lost = False
        self.streams: list[tuple[Any, ...]] = []
        self.opened = ""
        self.stopped = False

    def get_count(self) -> int:
        return len(self._serials)

    def get_device_by_index(self, index: int) -> Any:
        return self.get_device_by_serial_number(self._serials[index])

    def get_device_by_serial_number(self, serial: str) -> Any:
        if serial not in self._serials:
            raise OBError(f"device {serial} not found")
        self.opened = serial
        kinds = ["colour", "depth", "gyroscope", "accelerometer"][: 2 if self._imu is None else 4]
        sensors = SimpleNamespace(get_count=lambda: len(kinds), get_type_by_index=kinds.__getitem__)
        return SimpleNamespace(
            is_global_timestamp_supported=lambda: self._clock,
            enable_global_timestamp=lambda _enable: None,
            get_sensor_list=lambda: sensors,
        )

    def Config(self) -> Any:
        made = SimpleNamespace(rates={})
        made.enable_video_stream = lambda *given: self.streams.append(given)
        made.enable_gyro_stream = lambda sample_rate: made.rates.update(gyro=sample_rate)
        made.enable_accel_stream = lambda sample_rate: made.rates.update(accel=sample_rate)
        made.set_frame_aggregate_output_mode = lambda mode: setattr(made, "mode", mode)
        return made

    def Pipeline(self, device: Any) -> Library | ImuPipeline:
        made = next(self._pipelines)
        assert made is not None
        return made

    def get_stream_profile_list(self, kind: str) -> Any:
        assert kind == "colour"
        return SimpleNamespace(get_default_video_stream_profile=lambda: "colour profile")

    def start(self, config: Any) -> None:
        pass

    def stop(self) -> None:
        self.stopped = True

    def wait_for_frames(self, milliseconds: int) -> FrameSet | None:
        if self.lost:
            raise OBError("usb transfer failed")
        found = next(self._sets, None)
        if found is None:
            time.sleep(0.01)
        elif self._imu is not None and (image := found.get_color_frame()) is not None:
            self._imu.send_until(image)
        return found

    def AlignFilter(self, align_to_stream: str) -> Any:
        assert align_to_stream == "colour stream"
        return SimpleNamespace(process=lambda images: images)


COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def lens_of(model: LensModel, **values: float) -> Any:
    return SimpleNamespace(**dict.fromkeys(COEFFICIENTS, 0.0) | values, model=model)


NO_LENS = lens_of(LensModel.NONE)
RGB = np.arange(HEIGHT * WIDTH * 3, dtype=np.uint32).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)


UNIX_US = 1_700_000_000_000_000


def images(number: int, *, kind: str = "RGB") -> FrameSet:
    depth = np.full((HEIGHT, WIDTH), 2400, np.uint16)
    return FrameSet(Image(number, RGB, kind, UNIX_US, 0, NO_LENS), Image(number, depth, "Y16", UNIX_US, 4_000, NO_LENS))


def use(monkeypatch: pytest.MonkeyPatch, library: Library) -> Library:
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", library)
    return library


def seen(uri: str, count: int) -> list[Frame]:
    camera = open_camera(uri)
    frames = list(islice(iter(camera), count))
    camera.close()
    return frames


def test_frames_have_pixels_units_intrinsics_and_global_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    library = use(monkeypatch, Library([images(k) for k in range(3)]))
    frames = seen("orbbec://A1?size=96x72&fps=15", 3)
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.rgb, RGB)
        np.testing.assert_allclose(frame.depth, 0.6, rtol=1e-6)  # 2400 units of 0.25 mm
        assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == (70.0, 71.0, 40.5, 29.0)
        assert frame.stamp == pytest.approx(1.7e9 + number * 0.033333, abs=1e-6)
        assert frame.depth_delay == pytest.approx(0.004)
    assert library.opened == "A1"
    assert library.streams == [("colour stream", 96, 72, 15, "RGB"), ("depth stream", 0, 0, 15, "Y16")]


def test_without_a_global_clock_the_devices_is_shifted_by_the_first_image(monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, Library([images(k) for k in range(3)], clock=False))
    frames = seen("orbbec://", 3)
    assert frames[0].stamp == pytest.approx(1.7e9 + 0.012, abs=1e-6)  # of its arrival
    assert frames[2].stamp - frames[0].stamp == pytest.approx(2 * 0.033333, abs=1e-6)


RADIAL = {"k1": 0.3, "k2": -0.1, "p1": 0.02, "p2": -0.01, "k3": 0.05}
LENSES = {
    LensModel.BROWN_CONRADY: RADIAL,
    LensModel.BROWN_CONRADY_K6: RADIAL | {"k4": 0.2, "k5": -0.04, "k6": 0.003},
    LensModel.KANNALA_BRANDT4: {"k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": -0.003},
}


def lens_pair(lens: Any, depth_lens: Any) -> FrameSet:
    """Return smooth colours and a slope of depth, seen through lenses."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    units = np.rint(2400 + 10 * u + 8 * v).astype(np.uint16)
    color = Image(0, np.rint(pattern(u, v)).astype(np.uint8), "RGB", UNIX_US, 0, lens)
    return FrameSet(color, Image(0, units, "Y16", UNIX_US, 0, depth_lens))


def pattern(u: Array, v: Array) -> Array:
    return 128 + np.stack([100 * np.sin(u / 9), 100 * np.cos(v / 8), 90 * np.sin((u + v) / 11)], -1)


@pytest.mark.parametrize("model", list(LENSES))
@pytest.mark.parametrize("depth_has_it", [False, True], ids=["depth aligned without the lens", "depth with the lens"])
def test_each_image_is_undone_by_its_own_lens_as_opencv_defines_it(
    monkeypatch: pytest.MonkeyPatch, model: LensModel, depth_has_it: bool
) -> None:
    lens = lens_of(model, **LENSES[model])
    use(monkeypatch, Library([lens_pair(lens, lens if depth_has_it else lens_of(model))]))
    (frame,) = seen("orbbec://", 1)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    rays = np.stack([(u - 40.5) / 70, (v - 29) / 71, np.ones_like(u)], -1).reshape(-1, 1, 3)
    fisheye = model == LensModel.KANNALA_BRANDT4
    names = ("k1", "k2", "k3", "k4") if fisheye else COEFFICIENTS
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    K, known = np.array([[70.0, 0, 40.5], [0, 71, 29], [0, 0, 1]]), np.array([getattr(lens, name) for name in names])
    at = np.asarray(project(rays, np.zeros(3), np.zeros(3), K, known)[0], np.float64).reshape(HEIGHT, WIDTH, 2)
    assert np.abs(at - np.stack([u, v], -1)).max() > 2
    inner = (at > 1).all(-1) & (at[..., 0] < WIDTH - 2) & (at[..., 1] < HEIGHT - 2)
    assert inner.mean() > 0.6
    x, y = np.moveaxis(at, -1, 0)
    np.testing.assert_allclose(frame.rgb[inner], pattern(x, y)[inner], atol=2.5)
    of = (x, y) if depth_has_it else (u, v)
    wanted = 0.00025 * (2400 + 10 * of[0] + 8 * of[1])  # units of 0.25 mm
    np.testing.assert_allclose(frame.depth[inner], wanted[inner], atol=0.0025 if depth_has_it else 1e-6)
    assert frame.camera == Camera(70.0, 71.0, 40.5, 29.0, WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("lens", "depth_lens", "problem"),
    [
        (lens_of(LensModel.INVERSE_BROWN_CONRADY, **RADIAL), NO_LENS, "colour with a lens of the model INVERSE_BROWN"),
        (NO_LENS, lens_of(LensModel.MODIFIED_BROWN_CONRADY, **RADIAL), "depth with a lens of the model MODIFIED_BROWN"),
        (lens_of(LensModel.BROWN_CONRADY, k1=-20.0), NO_LENS, "a lens that folds the image.*calibrate it"),
    ],
)
def test_a_lens_that_cannot_be_rectified_is_refused_with_its_model_and_a_fix(
    monkeypatch: pytest.MonkeyPatch, lens: Any, depth_lens: Any, problem: str
) -> None:
    use(monkeypatch, Library([lens_pair(lens, depth_lens)]))
    with pytest.raises(DeviceError, match=f"{problem}.*ROS driver"):
        seen("orbbec://", 1)


def rows_of(frames: list[Frame], name: str) -> Array:
    return np.concatenate([getattr(frame.imu, name) for frame in frames])


@pytest.mark.parametrize("clock", [True, False], ids=["global clock", "device clock"])
@pytest.mark.parametrize("rates", [(200, 100), (100,)])
def test_samples_have_the_clock_and_axes_of_colour(
    monkeypatch: pytest.MonkeyPatch, clock: bool, rates: tuple[int, ...]
) -> None:
    R = so3_exp([0.4, -1.1, 0.6])
    imu = ImuPipeline(R, rates)
    use(monkeypatch, Library([images(k) for k in range(6)], clock=clock, imu=imu))
    frames = seen("orbbec://", 6)
    for name, z, first in (("gyroscope", 0.5, 0.0), ("accelerometer", 2.0, 0.001)):
        rows = rows_of(frames, name)
        assert len(rows) == 1 + (5 * 0.033333 - first) // (1 / rates[0])
        vectors = rows[:, 1:] @ R  # in the axes of the sensor
        np.testing.assert_allclose(vectors[:, 0], rows[:, 0] - frames[0].stamp, atol=1e-5)
        np.testing.assert_allclose(vectors[:, 1:], np.tile([-1.0, z], (len(rows), 1)), atol=1e-6)
        np.testing.assert_allclose(np.diff(rows[:, 0]), 1 / rates[0], atol=1e-5)
    for frame in frames:
        assert frame.imu is not None
        assert (frame.imu.gyro_stamps <= frame.stamp).all()
    assert imu.stopped


@pytest.mark.parametrize(
    ("imu", "problem"),
    [
        (ImuPipeline(np.zeros((3, 3))), "the matrix of its axes is no rotation"),
        (ImuPipeline(np.eye(3), rates=()), "no matched gyro stream profile"),
    ],
)
def test_an_imu_that_cannot_be_used_is_left_out_with_its_reason(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, imu: ImuPipeline, problem: str
) -> None:
    use(monkeypatch, Library([images(0)], imu=imu))
    (frame,) = seen("orbbec://", 1)
    assert frame.imu is None
    assert f"the IMU of orbbec:// is not used: {problem}" in caplog.text


def test_lost_images_are_counted_and_a_silent_device_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "CONSTANTS", device.RgbdDeviceConstants(silence_s=0.1, poll_s=0.01))
    library = use(monkeypatch, Library([images(0), None, FrameSet(None, None), images(4)]))
    camera = OrbbecCamera()
    after_lost = SimpleNamespace(monotonic=lambda: time.monotonic() if camera.dropped else 0.0)
    monkeypatch.setattr(device, "time", after_lost)  # the silence begins after the images that follow the lost ones
    with pytest.raises(DeviceError, match="is gone"):
        list(camera)
    assert camera.dropped == 3
    assert library.stopped


def test_a_device_that_is_unplugged_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    imu = ImuPipeline(np.eye(3))
    library = use(monkeypatch, Library([images(0), images(1)], imu=imu))
    frames = iter(OrbbecCamera())
    next(frames)
    library.lost = imu.lost = True
    with pytest.raises(DeviceError, match=r"is gone \(usb transfer failed\)"):
        next(frames)
    assert imu.stopped
    assert library.stopped


@pytest.mark.parametrize(("uri", "serials"), [("orbbec://", ()), ("orbbec://B7", ("A1",))])
def test_without_the_device_one_sentence_names_the_fix(
    monkeypatch: pytest.MonkeyPatch, uri: str, serials: tuple[str, ...]
) -> None:
    use(monkeypatch, Library([], serials=serials))
    with pytest.raises(DeviceError, match=r"cannot be opened.*USB 3"):
        next(iter(open_camera(uri)))


def test_images_of_another_format_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, Library([images(0, kind="MJPG")]))
    with pytest.raises(DeviceError, match="colour is MJPG"):
        seen("orbbec://", 1)


def test_without_the_package_one_sentence_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", None)
    with pytest.raises(DeviceError, match=r"splatbot\[orbbec\]"):
        next(iter(open_camera("orbbec://")))


def test_addresses_name_serial_size_and_rate() -> None:
    assert OrbbecCamera.from_uri("orbbec://A1?size=1280x720&fps=15").options == StreamOptions(1280, 720, 15.0)
    with pytest.raises(InputError, match="fps=fast"):
        open_camera("orbbec://?fps=fast")
