"""Lenses of CameraInfo in recordings of rosbags and in live topics, against rays traced in float64."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import rotation_to_quat, se3_exp, transform_points
from splatbot.logs import open_log
from splatbot.logs.calibration import Calibration, read_calibration, save_calibration
from splatbot.protocols import Array
from splatbot.services.ros.subscribers import FramePairs
from tests.lenses import FISHEYE, fisheye_rays, pinhole_rays, shelf

NARROW = Camera(110.0, 111.0, 79.0, 60.0, 160, 120)
T_COLOR_DEPTH = se3_exp([0.04, -0.02, 0.0, 0.0, 0.0, 0.0])
COLOR, DEPTH = "/cam/color", "/cam/depth"
ROS2, ROS1 = Stores.ROS2_JAZZY, Stores.ROS1_NOETIC


@cache
def traced(camera: Camera, moved: bool) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the images of a camera at the place of colour, whose frame is the world, or at that of depth."""
    rays = fisheye_rays(camera) if camera.fisheye else pinhole_rays(camera)
    rgb, depth, _ = shelf(rays, T_COLOR_DEPTH[:3, 3] * moved)
    return rgb, depth.astype(np.float32)


def messages(
    store: Typestore, color: Camera, depth: Camera, model: str = "equidistant", **info: Any
) -> list[tuple[str, str, Any]]:
    """Return topics, types and messages of one frame of the shelf, seen by two cameras; ``info`` changes CameraInfo."""
    t, ros1 = store.types, store is STORES[ROS1]
    time = t["builtin_interfaces/msg/Time"](5, 0)
    found = []
    for topic, camera, moved in ((COLOR, color, False), (DEPTH, depth, depth is not color)):
        name = "depth" if moved else "color"
        head = t["std_msgs/msg/Header"](*((7,) if ros1 else ()), time, name)
        rgb, z = traced(camera, moved)
        pixels = rgb if topic == COLOR else z
        size, encoding = (camera.height, camera.width), "rgb8" if topic == COLOR else "32FC1"
        step, data = pixels.strides[0], np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
        image = t["sensor_msgs/msg/Image"](head, *size, encoding, 0, step, data)
        values = {"d": np.array(camera.distortion), "k": camera.K.ravel()} | info
        lens = model if camera.fisheye or info else "plumb_bob"
        roi = t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        K, D = np.asarray(values["k"], np.float64), np.asarray(values["d"], np.float64)
        whole = t["sensor_msgs/msg/CameraInfo"](head, *size, lens, D, K, np.eye(3).ravel(), np.zeros(12), 0, 0, roi)
        found += [(f"{topic}/camera_info", "sensor_msgs/msg/CameraInfo", whole)]
        found += [(f"{topic}/image_raw", "sensor_msgs/msg/Image", image)]
    return found if depth is color else [*found, ("/tf_static", "tf2_msgs/msg/TFMessage", tf(store))]


def tf(store: Typestore) -> Any:
    t = store.types
    w, x, y, z = rotation_to_quat(T_COLOR_DEPTH[:3, :3]).tolist()
    vector = t["geometry_msgs/msg/Vector3"](*T_COLOR_DEPTH[:3, 3].tolist())
    turn = t["geometry_msgs/msg/Quaternion"](x, y, z, w)
    head = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](5, 0), "color")
    edge = t["geometry_msgs/msg/TransformStamped"](head, "depth", t["geometry_msgs/msg/Transform"](vector, turn))
    return t["tf2_msgs/msg/TFMessage"]([edge])


STORES = {name: get_typestore(name) for name in (ROS2, ROS1)}


def write(path: Path, kind: str, color: Camera, depth: Camera, **info: Any) -> str:
    """Write a recording: a rosbag2 folder, one of MCAP, or a ROS 1 bag."""
    store = STORES[ROS1 if kind == "bag" else ROS2]
    bag: Any = {
        "bag": lambda: Ros1Writer(path.with_suffix(".bag")),
        "mcap": lambda: Writer(path, version=9, storage_plugin=StoragePlugin.MCAP),
        "sqlite": lambda: Writer(path, version=9),
    }[kind]()
    with bag as out:
        for topic, name, message in messages(store, color, depth, **info):
            data = store.serialize_ros1(message, name) if kind == "bag" else store.serialize_cdr(message, name)
            out.write(out.add_connection(topic, name, typestore=store), 5 * 10**9, data)
    return str(path.with_suffix(".bag") if kind == "bag" else next(path.glob("*.mcap")) if kind == "mcap" else path)


def check(frame: Frame, color: Camera, depth: Camera) -> None:
    """Compare a frame with the rays of the pinhole camera of depth."""
    rays, origin = pinhole_rays(depth.pinhole), (np.zeros(3) if depth is color else T_COLOR_DEPTH[:3, 3])
    want, exact, board = shelf(rays, origin)
    assert frame.camera == depth.pinhole
    shown = frame.depth > 0
    near = np.minimum(np.abs(frame.depth - 1.0), np.abs(frame.depth - 2.0))
    assert near[shown].max() < 1e-6  # never between two surfaces
    smooth = shown & ~near_an_edge(board)
    assert smooth.mean() > 0.25
    np.testing.assert_allclose(frame.depth[smooth], exact[smooth], atol=1e-6)
    seen = smooth & unoccluded(frame.depth, rays, color, depth)
    np.testing.assert_allclose(frame.rgb[seen].astype(int), want[seen], atol=5)
    assert seen.mean() > 0.2


def near_an_edge(board: NDArray[np.bool_]) -> NDArray[np.bool_]:
    image, square = board.astype(np.uint8), np.ones((11, 11))
    near = cv2.dilate(image, square) != cv2.erode(image, square)
    near[:, [0, 1, -2, -1]] = near[[0, 1, -2, -1]] = True  # an edge may be outside of the image
    return np.asarray(near)


def unoccluded(z: NDArray[np.float32], rays: Array, color: Camera, depth: Camera) -> NDArray[np.bool_]:
    """Return the pixels whose wall point is not behind a board for the colour camera, or near its edge."""
    if depth is color:
        return np.ones(z.shape, np.bool_)
    points = transform_points(T_COLOR_DEPTH, rays * np.where(z > 0, z, 1.0)[..., None].astype(np.float64))
    seen = [shelf(points / points[..., 2:] * s + np.array([0, 0, 1 - s]))[2] for s in (0.97, 1.0, 1.03)]
    board = z < 1.5
    return np.all([a == board for a in seen], axis=0)


@pytest.mark.parametrize(("kind", "model"), [("mcap", "equidistant"), ("sqlite", "fisheye"), ("bag", "equidistant")])
def test_a_fisheye_of_a_recording_is_read_as_a_pinhole_camera(tmp_path: Path, kind: str, model: str) -> None:
    log = open_log(write(tmp_path / "a", kind, FISHEYE, FISHEYE, model=model))
    assert log.calibration.camera == FISHEYE
    check(log[0], FISHEYE, FISHEYE)


@pytest.mark.parametrize("color", [FISHEYE, NARROW], ids=["fisheye colour", "pinhole colour"])
@pytest.mark.parametrize("depth", [FISHEYE, NARROW], ids=["fisheye depth", "pinhole depth"])
def test_colour_and_depth_of_other_lenses_at_other_places_are_registered(
    tmp_path: Path, color: Camera, depth: Camera
) -> None:
    other = replace(depth, cx=depth.cx + 1)
    check(open_log(write(tmp_path / "a", "mcap", color, other))[0], color, other)


def live(color: Camera, depth: Camera, **info: Any) -> Frame:
    """Publish one frame and return the frame that the service makes of it."""
    pairs, frame = FramePairs(find_transform=lambda target, source: T_COLOR_DEPTH), None
    for topic, _, message in messages(STORES[ROS2], color, depth, **info):
        if topic != "/tf_static":
            frame = pairs.add(topic.replace("/cam/", "/camera/"), message) or frame
    assert frame is not None
    return frame


@pytest.mark.parametrize("color", [FISHEYE, NARROW], ids=["fisheye colour", "pinhole colour"])
def test_live_topics_of_a_fisheye_become_frames_of_a_pinhole_camera(color: Camera) -> None:
    depth = replace(FISHEYE, cx=79.0)
    check(live(color, depth), color, depth)
    check(live(FISHEYE, FISHEYE), FISHEYE, FISHEYE)


WRONG: dict[str, tuple[dict[str, Any], str, str]] = {
    "zeros": ({"d": [0.0] * 4}, "D: has no coefficients other than 0", "plumb_bob if the images are rectified"),
    "no coefficients": ({"d": []}, "D: has no coefficients other than 0", "plumb_bob"),
    "NaN": ({"d": [0.1, np.nan, 0.0, 0.0]}, "D: has values that are not finite", "calibrate"),
    "infinite": ({"d": [0.1, np.inf, 0.0, 0.0]}, "D: has values that are not finite", "calibrate"),
    "five of a fisheye": ({"d": [0.1] * 5}, r"D: has 5 coefficients \(equidistant\)", "give 4"),
    "three": ({"d": [0.1] * 3, "model": "plumb_bob"}, r"D: has 3 coefficients \(plumb_bob\)", "4, 5, 8, 12 or 14"),
    "nine": ({"d": [0.1] * 9, "model": "rational_polynomial"}, "D: has 9 coefficients", "4, 5, 8, 12 or 14"),
    "K of zeros": ({"k": [0.0] * 9}, "K: is all 0", "calibrate the camera"),
    "K of NaN": ({"k": [np.nan] * 9}, "fx: is nan", "finite"),
    "180 degrees": ({"k": [45.0, 0, 79.5, 0, 45.0, 59.5, 0, 0, 1], "d": [1e-6] * 4}, "D: sees 204 degrees", "crop"),
    "a fold": ({"d": [-3.0, 0.0, 0.0, 0.0]}, "D: folds the image", "order of the coefficients"),
    "another model": ({"d": [0.1] * 4, "model": "mei"}, "distortion_model: is 'mei'", "equidistant"),
}


def test_a_camera_info_that_makes_no_sense_is_refused_with_its_field_and_fix() -> None:
    for info, problem, fix in WRONG.values():
        with pytest.raises(InputError, match=problem) as caught:
            live(FISHEYE, FISHEYE, **info)
        assert fix in str(caught.value.hint)


@pytest.mark.parametrize("name", ["zeros", "K of zeros", "180 degrees"])
def test_a_recording_names_the_topic_of_a_camera_info_that_makes_no_sense(tmp_path: Path, name: str) -> None:
    info, problem, _ = WRONG[name]
    with pytest.raises(InputError, match=rf"/cam/color/camera_info {problem}"):
        open_log(write(tmp_path / "a", "mcap", FISHEYE, FISHEYE, **info))


@pytest.mark.parametrize(
    ("count", "model"), [(8, "rational_polynomial"), (12, "plumb_bob"), (14, "rational_polynomial")]
)
def test_lenses_of_8_12_and_14_coefficients_are_read(tmp_path: Path, count: int, model: str) -> None:
    lens = (0.1, -0.05, 0.002, -0.001, 0.01, 0.2, -0.04, 0.003, 0.004, -0.002, 0.003, 0.001, 0.01, -0.02)[:count]
    camera = replace(NARROW, distortion=lens)
    log = open_log(write(tmp_path / "a", "mcap", camera, camera, model=model, d=lens))
    assert log.calibration.camera == camera
    assert log[0].camera == NARROW
    assert live(camera, camera, model=model, d=lens).camera == NARROW


def test_a_camera_file_states_an_ideal_fisheye_that_a_camera_info_cannot_state(tmp_path: Path) -> None:
    ideal = replace(FISHEYE, distortion=(0.0,) * 4)
    path = write(tmp_path / "a", "mcap", ideal, ideal, model="plumb_bob", d=[])
    assert open_log(path).camera == ideal.pinhole  # as its CameraInfo states
    file = tmp_path / "lens.json"
    save_calibration(Calibration(ideal, 1000.0), file)
    assert read_calibration(file).camera == ideal
    check(open_log(path, camera=file)[0], ideal, ideal)
    file.write_text(file.read_text().replace("true", '"yes"'))
    with pytest.raises(InputError, match=r"lens\.json: fisheye: is 'yes'"):
        open_log(path, camera=file)
