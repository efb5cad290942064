"""Orbbec cameras: stand-ins of the classes of pyorbbecsdk2, by its stubs, are the other side of the driver."""

from __future__ import annotations

import sys
import time
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import DeviceError, InputError
from splatbot.frame import Frame
from splatbot.robots.cameras import OrbbecCamera, device, open_camera
from splatbot.robots.cameras.stream_options import StreamOptions

WIDTH, HEIGHT = 96, 72
DEVICE_EPOCH = 5_000_000  # [us] stamp of image 0 in the clock of the device


class OBError(Exception):
    """The exception of the library."""


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
    OBFrameAggregateOutputMode = SimpleNamespace(FULL_FRAME_REQUIRE="full")
    OBCameraDistortionModel = SimpleNamespace(BROWN_CONRADY=3, BROWN_CONRADY_K6=4)

    def __init__(self, sets: list[FrameSet | None], *, clock: bool = True, serials: tuple[str, ...] = ("A1",)) -> None:
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
        return SimpleNamespace(
            is_global_timestamp_supported=lambda: self._clock, enable_global_timestamp=lambda _enable: None
        )

    def Config(self) -> Any:
        return SimpleNamespace(
            enable_video_stream=lambda *given: self.streams.append(given),
            set_frame_aggregate_output_mode=lambda _: None,
        )

    def Pipeline(self, device: Any) -> Library:
        return self

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
        return found

    def AlignFilter(self, align_to_stream: str) -> Any:
        assert align_to_stream == "colour stream"
        return SimpleNamespace(process=lambda images: images)


NO_LENS = SimpleNamespace(k1=0, k2=0, p1=0, p2=0, k3=0, k4=0, k5=0, k6=0, model=0)
RGB = np.arange(HEIGHT * WIDTH * 3, dtype=np.uint32).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)


def images(number: int, unix_us: int = 1_700_000_000_000_000, *, lens: Any = NO_LENS, kind: str = "RGB") -> FrameSet:
    depth = np.full((HEIGHT, WIDTH), 2400, np.uint16)
    return FrameSet(Image(number, RGB, kind, unix_us, 0, lens), Image(number, depth, "Y16", unix_us, 4_000, lens))


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


def test_a_distorted_lens_is_undone_and_an_unknown_one_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"k1": 0.1, "k2": -0.05, "p1": 0.001, "p2": 0.0, "k3": 0.0, "k4": 0.0, "k5": 0.0, "k6": 0.0}
    use(monkeypatch, Library([images(0, lens=SimpleNamespace(**values, model=3))]))
    (frame,) = seen("orbbec://", 1)
    assert not frame.camera.distortion
    assert not (frame.rgb == RGB).all()
    use(monkeypatch, Library([images(0, lens=SimpleNamespace(**values, model=5))]))
    with pytest.raises(DeviceError, match="lens model 5"):
        seen("orbbec://", 1)


def test_lost_images_are_counted_and_a_silent_device_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "CONSTANTS", device.RgbdDeviceConstants(silence_s=0.1, poll_s=0.01))
    library = use(monkeypatch, Library([images(0), None, FrameSet(None, None), images(4)]))
    camera = OrbbecCamera()
    with pytest.raises(DeviceError, match="is gone"):
        list(camera)
    assert camera.dropped == 3
    assert library.stopped


def test_a_device_that_is_unplugged_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    library = use(monkeypatch, Library([images(0), images(1)]))
    frames = iter(OrbbecCamera())
    next(frames)
    library.lost = True
    with pytest.raises(DeviceError, match=r"is gone \(usb transfer failed\)"):
        next(frames)
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
