"""OAK cameras: the host part of the pipeline with recorded packets, and the messages without a device."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from itertools import islice
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import DeviceError, InputError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.protocols import Array
from splatbot.robots.cameras import OakCamera, device, open_camera
from splatbot.robots.cameras.stream_options import StreamOptions
from tests.conftest import MakeLog
from tests.unit.robots.cameras.recorded_packets import PERIOD_S, Packet, RecordedStreams, dai

DELAY_S = 0.004  # of depth


def packets(
    frames: list[Frame], *, kind: str = "RGB888i", lens: tuple[float, ...] = (), depth_lens: tuple[float, ...] = ()
) -> RecordedStreams:
    """Return the packets of a device that saw the frames from now on."""
    now = dai.Clock.now().total_seconds()  # type: ignore[call-arg]
    color, depth = [], []
    for k, frame in enumerate(frames):
        at = now + PERIOD_S * k
        image = frame.rgb if kind == "RGB888i" else cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)
        color.append(Packet(at, image, kind, frame.camera.K, k, lens))
        units = np.round(1000 * frame.depth).astype(np.uint16)
        depth.append(Packet(at + DELAY_S, units, "RAW16", frame.camera.K, k, depth_lens))
    return RecordedStreams(color, depth)


def seen(camera: OakCamera, count: int) -> list[Frame]:
    """Return frames of a camera, which is then closed."""
    frames = list(islice(iter(camera), count))
    camera.close()
    return frames


@pytest.mark.parametrize("kind", ["RGB888i", "BGR888i"])
def test_frames_have_the_pixels_intrinsics_units_and_stamps_of_the_packets(make_log: MakeLog, kind: str) -> None:
    recorded = list(open_log(make_log(4)))
    begun = time.time()
    frames = seen(OakCamera(streams=packets(recorded, kind=kind)), 4)
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    for k, (frame, source) in enumerate(zip(frames, recorded, strict=True)):
        np.testing.assert_array_equal(frame.rgb, source.rgb)
        np.testing.assert_array_equal(frame.depth, np.round(1000 * source.depth).astype(np.float32) / np.float32(1000))
        np.testing.assert_allclose(frame.camera.K, source.camera.K, rtol=1e-6)
        assert not frame.camera.distortion
        assert frame.stamp - frames[0].stamp == pytest.approx(PERIOD_S * k, abs=1e-5)
        assert frame.depth_delay == pytest.approx(DELAY_S, abs=1e-5)
    assert abs(frames[0].stamp - begun) < 2.0  # Unix time, not that of the device


def test_a_lens_with_distortion_is_undistorted_for_colour_and_depth(make_log: MakeLog) -> None:
    (source,) = list(open_log(make_log(1)))
    lens = (0.1, -0.2, 0.001, 0.002, 0.05)
    (frame,) = seen(OakCamera(streams=packets([source], lens=lens, depth_lens=lens)), 1)
    K = source.camera.K
    expected = cv2.undistort(source.rgb, K, np.array(lens)).astype(int)[8:-8, 8:-8]
    assert np.abs(frame.rgb.astype(int)[8:-8, 8:-8] - expected).max() <= 6  # cv2.undistort has a map of 1/32 px
    assert np.abs(source.rgb.astype(int)[8:-8, 8:-8] - expected).max() > 60
    assert not frame.camera.distortion
    assert (frame.depth == np.round(1000 * source.depth).astype(np.float32) / np.float32(1000)).mean() < 1.0


FISH = (0.05, -0.02, 0.01, -0.003)
THIN = (0.1, -0.05, 0.002, -0.001, 0.01, 0.2, -0.04, 0.003, 0.004, -0.002, 0.003, 0.001, 0.01, -0.02)
K = np.array([[120.0, 0, 81.0], [0, 118.0, 58.5], [0, 0, 1]])


def pattern(u: Array, v: Array) -> Array:
    """Return colours (..., 3) that change smoothly with the pixel."""
    return 128 + np.stack([100 * np.sin(u / 9), 100 * np.cos(v / 8), 90 * np.sin((u + v) / 11)], -1)


@pytest.mark.parametrize(("model", "lens"), [("Fisheye", FISH), ("Perspective", THIN)])
@pytest.mark.parametrize("aligned", ["without the lens", "with the lens"])
def test_a_wide_lens_is_undone_as_opencv_and_depthai_define_it_and_depth_by_its_own_lens(
    model: str, lens: tuple[float, ...], aligned: str
) -> None:
    v, u = np.mgrid[:120, :160].astype(np.float64)
    now = dai.Clock.now().total_seconds()  # type: ignore[call-arg]
    color = Packet(now, np.rint(pattern(u, v)).astype(np.uint8), "RGB888i", K, 0, lens, model)
    units = np.rint(1000 + 4 * u + 3 * v).astype(np.uint16)
    own = lens if aligned == "with the lens" else ()
    depth = Packet(now, units, "RAW16", K, 0, own, model)  # depthai clears the coefficients, and keeps the model
    (frame,) = seen(OakCamera(streams=RecordedStreams([color], [depth])), 1)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if model == "Fisheye" else cv2.projectPoints
    at = np.asarray(project(rays, np.zeros(3), np.zeros(3), K, np.array(lens))[0]).reshape(120, 160, 2)
    by_depthai = color.transformation.project3DPoint(dai.Point3f(*rays[0, 0].tolist()))
    np.testing.assert_allclose([by_depthai.x, by_depthai.y], at[0, 0], atol=1e-3)
    assert np.abs(at - np.stack([u, v], -1)).max() > 5
    inner = (at > 1).all(-1) & (at[..., 0] < 158) & (at[..., 1] < 118)
    assert inner.mean() > 0.6
    np.testing.assert_allclose(frame.rgb[inner], pattern(*np.moveaxis(at, -1, 0))[inner], atol=2.5)
    x, y = np.moveaxis(at, -1, 0) if own else (u, v)
    np.testing.assert_allclose(frame.depth[inner], (1 + 0.004 * x + 0.003 * y)[inner], atol=0.0041 if own else 1e-6)
    assert frame.camera == Camera(120.0, 118.0, 81.0, 58.5, 160, 120)


WIDE = np.array([[20.0, 0, 31.5], [0, 20.0, 23.5], [0, 0, 1]])


def _changed(streams: RecordedStreams, what: str, **values: object) -> RecordedStreams:
    packet = getattr(streams, f"_{what}")[0]
    setattr(streams, f"_{what}", [Packet(**{**packet.__dict__, **values})])
    return streams


@pytest.mark.parametrize(
    ("what", "values", "named"),
    [
        ("depth", {"kind": "RAW8", "image": np.ones((48, 64), np.uint8)}, "RAW8"),
        ("depth", {"image": np.ones((24, 32), np.uint16)}, "24"),
        ("color", {"kind": "GRAY8", "image": np.ones((48, 64), np.uint8)}, "48"),
        ("color", {"K": np.eye(3)}, "fx"),
        ("color", {"lens": (0.1,), "model": "RadialDivision"}, "colour with a lens of the model RadialDivision"),
        ("depth", {"lens": (0.1,), "model": "RadialDivision"}, "depth with a lens of the model RadialDivision"),
        ("color", {"model": "Cylindrical"}, "colour with a lens of the model Cylindrical"),
        ("color", {"lens": (-20.0,)}, "a lens that folds the image.*calibrate it"),
        ("color", {"lens": (0.001,), "model": "Fisheye", "K": WIDE}, "sees .* degrees.*ROS"),
        ("color", {"lens": (np.nan,)}, "not finite"),
    ],
)
def test_images_of_another_kind_are_refused_by_name(
    make_log: MakeLog, what: str, values: dict[str, NDArray[np.uint16]], named: str
) -> None:
    (source,) = list(open_log(make_log(1)))
    with pytest.raises(DeviceError, match=named):
        seen(OakCamera(streams=_changed(packets([source]), what, **values)), 1)


def test_a_silent_device_is_gone_and_lost_images_are_counted(
    make_log: MakeLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "CONSTANTS", device.RgbdDeviceConstants(silence_s=0.5))
    streams = packets(list(open_log(make_log(6))))
    for part in ("_color", "_depth"):
        setattr(streams, part, [p for p in getattr(streams, part) if p.sequence not in (2, 3)])
    camera = OakCamera(streams=streams)
    after_lost = SimpleNamespace(monotonic=lambda: time.monotonic() if camera.dropped else 0.0)
    monkeypatch.setattr(device, "time", after_lost)  # the silence begins after the images that follow the lost ones
    with pytest.raises(DeviceError, match="is gone"):
        list(camera)
    assert camera.dropped == 2


def test_a_closed_camera_ends(make_log: MakeLog) -> None:
    camera = OakCamera(streams=packets(list(open_log(make_log(2)))))
    frames = []
    for frame in camera:
        frames.append(frame)
        camera.close()
    assert len(frames) == 1
    assert not list(camera)


def test_a_driver_leaves_the_signals_of_the_process_alone() -> None:
    code = (
        "from splatbot.robots.cameras.oak import _depthai; _depthai(); import resource, signal, tempfile;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)); f = tempfile.TemporaryFile(buffering=0)\n"
        "try:\n    [f.write(bytes(999)) for _ in range(3)]\nexcept OSError:\n    print('full')"
    )
    plain = {name: value for name, value in os.environ.items() if not name.startswith("DEPTHAI_")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=plain)
    assert (done.returncode, done.stdout) == (0, "full\n"), done.stderr[-500:]


def test_without_a_device_one_sentence_names_the_fix() -> None:
    with pytest.raises(DeviceError, match="USB 3") as caught:
        next(iter(open_camera("oak://")))
    assert caught.value.file == "oak://"


def test_addresses_name_serial_size_and_rate() -> None:
    camera = OakCamera.from_uri("oak://14442C10D13EABCE00?size=1280x800&fps=15")
    assert camera.options == StreamOptions(1280, 800, 15.0)
    assert camera.uri == "oak://14442C10D13EABCE00"
    for wrong in ("size=10x10", "size=640", "fps=0", "fps=nan", "rate=3"):
        with pytest.raises(InputError, match="camera"):
            open_camera(f"oak://?{wrong}")
