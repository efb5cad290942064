"""Depth cameras of OpenCV: a stand-in of cv2.VideoCapture, by its documentation, is the other side of the driver."""

from __future__ import annotations

import json
import time
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, DeviceError, InputError
from splatbot.frame import Frame
from splatbot.layouts import is_camera
from splatbot.logs.calibration import Calibration, save_calibration
from splatbot.robots.cameras import OpenCvCamera, device, open_camera

CAMERA = Camera(70.0, 71.0, 40.5, 29.0, 96, 72)
BGR = np.zeros((72, 96, 3), np.uint8) + np.array([10, 20, 30], np.uint8)


class Capture:
    """cv2.VideoCapture of OpenNI2: grab, then retrieve the channels of the same time."""

    def __init__(self, count: int, *, depth: NDArray[Any] | None = None, unplugged: bool = False) -> None:
        self._left, self._unplugged = count, unplugged
        self._depth = np.full((72, 96), 600, np.uint16) if depth is None else depth
        self.properties: dict[int, float] = {}
        self.opened: tuple[int | str, int] | None = None
        self.released = False

    def __call__(self, place: int | str, backend: int) -> Capture:
        self.opened = place, backend
        return self

    def isOpened(self) -> bool:
        return self._left > 0 or not self._unplugged

    def set(self, key: int, value: float) -> bool:
        self.properties[key] = value
        return True

    def grab(self) -> bool:
        self._left -= 1
        return self._left >= 0

    def retrieve(self, _image: None, channel: int) -> tuple[bool, NDArray[Any]]:
        return True, {cv2.CAP_OPENNI_BGR_IMAGE: BGR, cv2.CAP_OPENNI_DEPTH_MAP: self._depth}[channel]

    def release(self) -> None:
        self.released = True


def test_frames_have_colours_metres_and_the_camera_of_the_file() -> None:
    capture = Capture(3)
    camera = OpenCvCamera("1", Calibration(CAMERA, 1000.0), open_capture=capture)
    before = time.time()
    frames = list(islice(iter(camera), 3))
    for number, frame in enumerate(frames):
        assert (frame.rgb == [30, 20, 10]).all()
        np.testing.assert_allclose(frame.depth, 0.6, rtol=1e-6)
        assert (frame.camera, frame.index) == (CAMERA, number)
        assert before <= frame.stamp <= time.time()
    assert capture.opened == (1, cv2.CAP_OPENNI2)
    assert capture.properties == {cv2.CAP_PROP_OPENNI_REGISTRATION: 1}


def test_the_unit_of_depth_is_that_of_the_camera_file() -> None:
    camera = OpenCvCamera("0", Calibration(CAMERA, 1010.0), open_capture=Capture(1))
    np.testing.assert_allclose(next(iter(camera)).depth, 600 / 1010, rtol=1e-6)


def test_a_distorted_lens_is_undone() -> None:
    lens = Camera(70.0, 71.0, 40.5, 29.0, 96, 72, (0.1, -0.05, 0.0, 0.0))
    frame = next(iter(OpenCvCamera("0", Calibration(lens, 1000.0), open_capture=Capture(1))))
    assert not frame.camera.distortion


@pytest.mark.parametrize("unplugged", [True, False])
def test_a_lost_and_a_silent_device_are_gone(monkeypatch: pytest.MonkeyPatch, unplugged: bool) -> None:
    quick = device.RgbdDeviceConstants(silence_s=0.1, poll_s=0.01)
    monkeypatch.setattr(device, "CONSTANTS", quick)
    monkeypatch.setattr("splatbot.robots.cameras.opencv.DEVICE", quick)
    capture = Capture(2, unplugged=unplugged)
    frames: list[Frame] = []
    with pytest.raises(DeviceError, match="is gone"):
        frames.extend(OpenCvCamera("0", Calibration(CAMERA, 1000.0), open_capture=capture))
    assert capture.released


def test_images_of_another_size_or_type_are_refused() -> None:
    small = Calibration(Camera(70.0, 71.0, 40.5, 29.0, 90, 72), 1000.0, "camera.json")
    with pytest.raises(CameraError, match=r"camera\.json.*is for 90x72"):
        next(iter(OpenCvCamera("0", small, open_capture=Capture(1))))
    metres = Capture(1, depth=np.full((72, 96), 0.6, np.float32))
    with pytest.raises(DeviceError, match="depth is float32"):
        next(iter(OpenCvCamera("0", Calibration(CAMERA, 1000.0), open_capture=metres)))


def test_addresses_name_the_camera_its_file_and_the_backend(tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    save_calibration(Calibration(CAMERA, 1000.0), file)
    for uri in (f"opencv://0?camera={file}", f"opencv://rtsp://host/a?b?backend=obsensor&camera={file}"):
        assert is_camera(uri)
        assert isinstance(open_camera(uri), OpenCvCamera)
    for wrong in (
        "opencv://",
        "opencv://0",
        f"opencv://0?camera={file}&fps=3",
        f"opencv://0?camera={file}&backend=v4l",
    ):
        with pytest.raises(InputError, match=r"camera\.json") as caught:
            open_camera(wrong)
        assert caught.value.hint
    with pytest.raises(CameraError, match="neither a preset nor a file"):
        open_camera("opencv://0?camera=nowhere.json")
    file.write_text(json.dumps({"fx": 1}))
    with pytest.raises(CameraError, match="fy"):
        open_camera(f"opencv://0?camera={file}")


def test_without_the_device_one_sentence_names_the_fix() -> None:
    camera = OpenCvCamera("63", Calibration(CAMERA, 1000.0))
    with pytest.raises(DeviceError, match=r"cannot be opened.*getBuildInformation"):
        next(iter(camera))
