"""Recordings of RealSense: `.db3` by librealsense's own recorder, `.bag` by the layout of its former versions."""

from __future__ import annotations

import sqlite3
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from splatbot.cli import main
from splatbot.errors import CameraError, LogError
from splatbot.logs import open_log

WIDTH, HEIGHT, UNITS, FRAMES = 160, 120, 0.00025, 5
FX, FX_COLOR = 130.0, 140.0
TURN = 0.1  # [rad] of the colour camera about its axis
ROTATION = [np.cos(TURN), np.sin(TURN), 0.0, -np.sin(TURN), np.cos(TURN), 0.0, 0.0, 0.0, 1.0]  # by columns
MOVE = [0.05, 0.002, -0.003]  # [m], points of depth to those of colour
Pair = tuple[NDArray[np.uint8], NDArray[np.uint16]]


def images(count: int = FRAMES) -> list[Pair]:
    """Return colour with a gradient, and depth with a step from 0.5 m to 1 m, of each frame."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth = np.where(u < WIDTH // 2, 0.5, 1.0)
    colors = [np.stack([u, 2 * v, np.full_like(u, 20 * k)], axis=2).astype(np.uint8) for k in range(count)]
    return [(rgb, np.round((depth + 0.01 * k) / UNITS).astype(np.uint16)) for k, rgb in enumerate(colors)]


def recorded(
    path: Path,
    frames: list[Pair],
    *,
    color: bool = True,
    lens: tuple[float, ...] = (0.0,) * 5,
    model: str = "brown_conrady",
) -> Path:
    """Record a software device with librealsense."""
    rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 (extra realsense) is not installed")
    device = rs.software_device()
    profiles = []
    for name, stream, kind, size, focal in (
        ("Stereo Module", rs.stream.depth, rs.format.z16, 2, FX),
        ("RGB Camera", rs.stream.color, rs.format.rgb8, 3, FX_COLOR),
    ):
        if size == 3 and not color:
            continue
        sensor, video, inner = device.add_sensor(name), rs.video_stream(), rs.intrinsics()
        inner.width, inner.height, inner.fx, inner.fy, inner.ppx, inner.ppy = WIDTH, HEIGHT, focal, focal, 79.5, 59.5
        inner.model, inner.coeffs = rs.distortion.brown_conrady, [0.0] * 5
        if size == 3:
            inner.model, inner.coeffs = getattr(rs.distortion, model), list(lens)
        video.type, video.index, video.uid, video.fmt, video.bpp = stream, 0, size, kind, size
        video.width, video.height, video.fps, video.intrinsics = WIDTH, HEIGHT, 30, inner
        profiles.append((sensor, sensor.add_video_stream(video), size))
        if size == 2:
            sensor.add_read_only_option(rs.option.depth_units, UNITS)
    if color:
        moved = rs.extrinsics()
        moved.rotation, moved.translation = ROTATION, MOVE
        profiles[0][1].register_extrinsics_to(profiles[1][1], moved)
    recorder = rs.recorder(str(path), device)
    queue = rs.frame_queue(100)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for number, (rgb, depth) in enumerate(frames):
        for sensor, profile, size in profiles:
            frame = rs.software_video_frame()
            frame.pixels = np.ascontiguousarray(depth if size == 2 else rgb)
            frame.stride, frame.bpp, frame.frame_number = WIDTH * size, size, number + 1
            frame.timestamp, frame.domain = 1.7e12 + 1000 * number / 30, rs.timestamp_domain.system_time
            frame.profile = profile.as_video_stream_profile()
            if size == 2:
                frame.depth_units = UNITS
            sensor.on_video_frame(frame)
        time.sleep(0.05)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    del recorder, sensors
    return path


def written_bag(path: Path, frames: list[Pair]) -> Path:
    """Write the `.bag` of librealsense 2.55, whose images have four more bytes than sensor_msgs/Image."""
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with Writer(path) as out:
        known: dict[str, Any] = {}

        def write(topic: str, kind: str, at: int, data: bytes) -> None:
            if topic not in known:
                known[topic] = out.add_connection(topic, kind, typestore=store)
            out.write(known[topic], at, data)

        def put(topic: str, kind: str, **values: Any) -> None:
            write(topic, kind, 1, bytes(store.serialize_ros1(types[kind](**values), kind)))

        stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
        head = types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="")
        region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
        put("/file_version", "std_msgs/msg/UInt32", data=4)
        for sensor, name, focal, q, t in (
            (0, "Depth_0", FX, (0.0, -1.0), (0.0, 0.0, 0.0)),
            (1, "Color_0", FX_COLOR, (-np.sin(TURN / 2), -np.cos(TURN / 2)), MOVE),  # -q is the same rotation
        ):
            stream = f"/device_0/sensor_{sensor}/{name}"
            put(
                f"{stream}/info/camera_info",
                "sensor_msgs/msg/CameraInfo",
                header=head,
                height=HEIGHT,
                width=WIDTH,
                distortion_model="Brown Conrady",
                D=np.zeros(5),
                K=np.array([focal, 0, 79.5, 0, focal, 59.5, 0, 0, 1]),
                R=np.zeros(9),
                P=np.zeros(12),
                binning_x=0,
                binning_y=0,
                roi=region,
            )
            put(
                f"{stream}/tf/1",
                "geometry_msgs/msg/Transform",
                translation=vector(*t),
                rotation=quaternion(0.0, 0.0, *q),
            )
        put("/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", data=UNITS)
        for number, pair in enumerate(frames):
            nanoseconds = 1_700_000_000 * 10**9 + round(1e9 * number / 30)
            for sensor, name, encoding, pixels in (
                (0, "Depth_0", b"mono16", pair[1]),
                (1, "Color_0", b"rgb8", pair[0]),
            ):
                data = pixels.tobytes()
                raw = struct.pack("<IIII1s", number + 1, *divmod(nanoseconds, 10**9), 1, b"1")
                raw += struct.pack("<III", HEIGHT, WIDTH, len(encoding)) + encoding
                raw += struct.pack("<BII", 0, pixels.strides[0], len(data)) + data + b"\0\0\0\0"
                topic = f"/device_0/sensor_{sensor}/{name}/image/data"
                write(topic, "sensor_msgs/msg/Image", 1000 + number * 10**8, raw)
    return path


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording by librealsense."""
    return recorded(tmp_path_factory.mktemp("realsense") / "desk.db3", images())


@pytest.mark.parametrize("kind", ["db3", "bag"])
def test_frames_have_the_depth_units_intrinsics_and_stamps_of_the_recording(
    database: Path, tmp_path: Path, kind: str
) -> None:
    log = open_log(database if kind == "db3" else written_bag(tmp_path / "desk.bag", images()))
    assert len(log) == FRAMES
    assert (log.camera.fx, log.camera.cx, log.camera.width) == (FX, 79.5, WIDTH)
    for k, frame in enumerate(log):
        assert frame.stamp == pytest.approx(1.7e9 + k / 30, abs=1e-5)
        assert frame.depth_delay == pytest.approx(0.0, abs=1e-6)
        near, far = frame.depth[:, : WIDTH // 2], frame.depth[:, WIDTH // 2 :]
        np.testing.assert_allclose(near[near > 0], 0.5 + 0.01 * k, rtol=1e-6)
        np.testing.assert_allclose(far[far > 0], 1.0 + 0.01 * k, rtol=1e-6)
        assert (frame.depth > 0).mean() > 0.7


@pytest.mark.parametrize("kind", ["db3", "bag"])
def test_colour_is_that_at_the_projection_of_each_depth_pixel(database: Path, tmp_path: Path, kind: str) -> None:
    frame = open_log(database if kind == "db3" else written_bag(tmp_path / "desk.bag", images()))[0]
    R = np.array([[np.cos(TURN), -np.sin(TURN), 0], [np.sin(TURN), np.cos(TURN), 0], [0, 0, 1]])
    checked = 0
    for v in range(8, HEIGHT - 8, 9):
        for u in range(8, WIDTH - 8, 9):
            z = float(frame.depth[v, u])
            p = R @ np.array([(u - 79.5) / FX * z, (v - 59.5) / FX * z, z]) + MOVE
            at = FX_COLOR * p[:2] / p[2] + [79.5, 59.5]
            if z == 0 or (at < 2).any() or at[0] > WIDTH - 3 or at[1] > HEIGHT - 3:
                continue
            assert np.abs(frame.rgb[v, u, :2] - np.array([at[0], 2 * at[1]])).max() < 2.5
            checked += 1
    assert checked > 80


def test_a_lens_is_undistorted_before_colour_is_registered(tmp_path: Path) -> None:
    plain, lens = (
        open_log(recorded(tmp_path / f"{name}.db3", images(1), lens=values))[0]
        for name, values in (("plain", (0.0,) * 5), ("lens", (0.15, 0.0, 0.0, 0.0, 0.0)))
    )
    moved = np.abs(lens.rgb.astype(int) - plain.rgb)[..., 0]
    assert moved[:, 140:].mean() > 2 * moved[:, 70:90].mean()  # radial: growing from the middle


BROWN = (0.3, -0.2, 0.06, -0.05, 0.05)


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("none", BROWN),
        ("brown_conrady", BROWN),
        ("modified_brown_conrady", BROWN),
        ("inverse_brown_conrady", BROWN),
        ("kannala_brandt4", (0.05, -0.02, 0.01, -0.003, 0.0)),
    ],
)
def test_each_depth_pixel_has_the_colour_where_librealsense_projects_its_point(
    tmp_path: Path, model: str, lens: tuple[float, ...]
) -> None:
    rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 (extra realsense) is not installed")
    frame = open_log(recorded(tmp_path / "a.db3", images(1), lens=lens, model=model))[0]
    depth, color, moved = rs.intrinsics(), rs.intrinsics(), rs.extrinsics()
    for inner, focal, kind, values in ((depth, FX, "none", [0.0] * 5), (color, FX_COLOR, model, list(lens))):
        inner.width, inner.height, inner.fx, inner.fy, inner.ppx, inner.ppy = WIDTH, HEIGHT, focal, focal, 79.5, 59.5
        inner.model, inner.coeffs = getattr(rs.distortion, kind), values
    moved.rotation, moved.translation = ROTATION, MOVE
    errors = []
    for v in range(5, HEIGHT - 5, 6):
        for u in [*range(5, WIDTH // 2 - 12, 6), *range(WIDTH // 2 + 12, WIDTH - 5, 6)]:
            point = rs.rs2_deproject_pixel_to_point(depth, [u, v], 0.5 if u < WIDTH // 2 else 1.0)
            x, y = rs.rs2_project_point_to_pixel(color, rs.rs2_transform_point_to_point(moved, point))
            if 2 < x < WIDTH - 3 and 2 < y < HEIGHT - 3 and frame.depth[v, u] > 0:
                errors.append(np.abs(frame.rgb[v, u, :2] - np.array([x, 2 * y])).max())
    assert len(errors) > 150
    assert max(errors) < 1.5


def test_a_lens_of_another_model_is_refused_with_its_name(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.db3", images(1), lens=(0.9, 0.0, 0.0, 0.0, 0.0), model="ftheta")
    with pytest.raises(CameraError, match=r"Color_0 distortion_model: is 'Ftheta'"):
        open_log(path)


def test_it_is_mapped_and_described_as_any_log(database: Path, tmp_path: Path, capsys: Any) -> None:
    assert main(["info", str(database)]) == 0
    assert "30.0 Hz" in capsys.readouterr().out
    assert main(["convert-log", str(database), str(tmp_path / "tum"), "--quiet"]) == 0
    assert len(open_log(tmp_path / "tum")) == FRAMES


def test_a_recording_without_colour_names_its_streams(tmp_path: Path) -> None:
    path = recorded(tmp_path / "depth.db3", images(2), color=False)
    with pytest.raises(LogError, match="Depth_0"):
        open_log(path)


@pytest.mark.parametrize("share", [0.3, 0.7, 0.95])
@pytest.mark.parametrize("kind", ["db3", "bag"])
def test_a_file_that_is_cut_off_is_an_error_of_the_log_or_of_its_frames(
    database: Path, tmp_path: Path, kind: str, share: float
) -> None:
    whole = database if kind == "db3" else written_bag(tmp_path / "whole.bag", images())
    path = tmp_path / f"cut.{kind}"
    path.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    with pytest.raises(LogError):
        list(open_log(path))


_TEXTS = {
    "/device_0/sensor_0/option/Depth_Units/value": ["0", "nan", "-1", "x", "1e9"],
    "/device_0/sensor_0/Depth_0/camera_info": ["", "width=1e9;height=1e9;fx=1;fy=1;ppx=0;ppy=0", "width=nan"],
    "/device_0/sensor_1/Color_0/tf/ref_1": [
        "",
        "rotation=1,2;translation=0",
        "rotation=2,0,0,0,2,0,0,0,2;translation=0,0,0",
    ],
    "/device_0/sensor_0/Depth_0/image/metadata": ["", "timestamp=nan;", "timestamp=x;"],
}


@pytest.mark.parametrize(("topic", "text"), [(topic, text) for topic, texts in _TEXTS.items() for text in texts])
def test_damaged_texts_are_refused_by_name(database: Path, tmp_path: Path, topic: str, text: str) -> None:
    path = tmp_path / "damaged.db3"
    path.write_bytes(database.read_bytes())
    data = b"\0\1\0\0" + struct.pack("<I", len(text) + 1) + text.encode() + b"\0"
    with sqlite3.connect(path) as file:
        (number,) = file.execute("SELECT id FROM topics WHERE name = ?", (topic,)).fetchone()
        file.execute("UPDATE messages SET data = ? WHERE topic_id = ?", (data, number))
    with pytest.raises((LogError, CameraError)) as refused:
        open_log(path)
    assert refused.value.file is not None


def test_another_file_of_that_ending_is_named(tmp_path: Path) -> None:
    path = tmp_path / "rosbag2_0.db3"
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT)")
    with pytest.raises(LogError, match=r"metadata\.yaml"):
        open_log(path)
