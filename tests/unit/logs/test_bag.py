"""Recordings of ROS topics read as logs, and logs recorded as such."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from splatbot.config import load_config
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs import open_log, record
from splatbot.logs.bag import BagLog
from splatbot.logs.mcap import COLOR, DEPTH, INFO, McapFile, record_mcap
from splatbot.logs.ros_frames import camera_info_message, header, image_message
from splatbot.logs.ros_types import build
from splatbot.run import map_log
from tests.conftest import MakeLog


def _same(a: Frame, b: Frame) -> bool:
    masks = (a.mask is None) == (b.mask is None) and (a.mask is None or bool((a.mask == b.mask).all()))
    images = bool((a.rgb == b.rgb).all()) and bool((a.depth == b.depth).all())
    return images and masks and a.camera == b.camera and abs(a.stamp - b.stamp) < 1e-9


def test_a_recording_gives_back_every_frame_bit_for_bit_with_its_joints_mask_and_reference(
    make_log: MakeLog, tmp_path: Path
) -> None:
    folder = make_log()
    cv2.imwrite(str(folder / "mask.png"), np.pad(np.zeros((8, 64), np.uint8), ((0, 40), (0, 0)), constant_values=255))
    (folder / "joints.txt").write_text("".join(f"{i / 30:.6f} {0.1 * i} {1 / (i + 1)}\n" for i in range(5)))
    log = open_log(folder)
    back = open_log(record_mcap(log, tmp_path / "a.mcap"))
    assert len(back) == 5
    for a, b in zip(log, back, strict=True):
        assert _same(a, b)
        np.testing.assert_array_equal(a.joints, b.joints)
    truth, told = log.ground_truth, back.ground_truth
    assert truth is not None
    assert told is not None
    np.testing.assert_allclose(told.T_world_camera, truth.T_world_camera, atol=1e-15)
    assert _same(log[3], back[3])  # in any order
    assert _same(log[0], back[-5])


def test_mapping_a_recording_gives_the_trajectory_of_the_log_it_was_made_from(tmp_path: Path) -> None:
    scene = open_log("synthetic:tabletop?frames=6&width=160&height=120")
    # Stamps in microseconds, as cameras have them: ROS cannot represent a third of a nanosecond.
    log = open_log(record((replace(f, stamp=round(f.stamp, 6)) for f in scene), tmp_path / "desk"))
    record_mcap(log, tmp_path / "a.mcap")
    runs, config = [], load_config(overrides={"mapping.final_iterations": 0})  # which the trajectory is free of
    for name, source in (("log", log), ("bag", open_log(tmp_path / "a.mcap"))):
        map_log(source, config=config, out=tmp_path / name, max_frames=40, save_every=None, report=False)
        runs.append((tmp_path / name / "trajectory.tum").read_text())
    assert runs[0] == runs[1]


@pytest.mark.long
def test_mapping_a_recording_of_a_real_log_gives_the_same_trajectory(data_root: Path, tmp_path: Path) -> None:
    log = open_log(data_root / "apc_shelf_robot")
    record_mcap(log, tmp_path / "a.mcap")
    for name, source in (("log", log), ("bag", open_log(tmp_path / "a.mcap"))):
        map_log(source, config=load_config(None), out=tmp_path / name, max_frames=40, save_every=None, report=False)
    assert (tmp_path / "log/trajectory.tum").read_text() == (tmp_path / "bag/trajectory.tum").read_text()


def test_the_reader_of_rosbags_reads_the_recorded_messages(make_log: MakeLog, tmp_path: Path) -> None:
    log = open_log(make_log())
    record_mcap(log, tmp_path / "a.mcap")
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        found = [(reader.deserialize(raw, c.msgtype), at) for c, at, raw in reader.messages() if c.topic == DEPTH]
    assert [at for _, at in found] == [round(f.stamp * 1e9) for f in log]
    message: Any = found[2][0]
    assert (message.encoding, message.height, message.width) == ("32FC1", 48, 64)
    np.testing.assert_array_equal(message.data.view(np.float32).reshape(48, 64), log[2].depth)


def test_a_ros_1_bag_with_millimetres_and_padded_bgr_rows_reads_the_same(make_log: MakeLog, tmp_path: Path) -> None:
    store, log = get_typestore(Stores.ROS1_NOETIC), open_log(make_log())
    t = store.types
    with Ros1Writer(tmp_path / "a.bag") as bag:
        kinds = {COLOR: "sensor_msgs/msg/Image", DEPTH: "sensor_msgs/msg/Image", INFO: "sensor_msgs/msg/CameraInfo"}
        to = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for frame in log:
            ns = round(frame.stamp * 1e9)
            head = t["std_msgs/msg/Header"](7, t["builtin_interfaces/msg/Time"](*divmod(ns, 10**9)), "c")
            padded = np.pad(frame.rgb[..., ::-1].reshape(48, -1), ((0, 0), (0, 8))).ravel()
            depth = np.rint(frame.depth * 1000).astype("<u2").reshape(-1).view(np.uint8)
            image, info = t["sensor_msgs/msg/Image"], t["sensor_msgs/msg/CameraInfo"]
            roi = t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            K = frame.camera.K.ravel()
            messages = {
                COLOR: image(head, 48, 64, "bgr8", 0, 200, padded),
                DEPTH: image(head, 48, 64, "16UC1", 0, 128, depth),
                INFO: info(head, 48, 64, "plumb_bob", np.zeros(5), K, np.eye(3).ravel(), np.zeros(12), 0, 0, roi),
            }
            for topic, message in messages.items():
                bag.write(to[topic], ns, store.serialize_ros1(message, kinds[topic]))
    back = open_log(tmp_path / "a.bag")
    assert back.camera == log.camera
    for a, b in zip(log, back, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_allclose(a.depth, b.depth, atol=0.0005)


def test_compressed_colour_and_depth_are_read(make_log: MakeLog, tmp_path: Path) -> None:
    frame = open_log(make_log())[0]
    head = header(1.0, "c")
    color, depth = "/camera/color/image_raw/compressed", "/camera/depth/image_raw/compressedDepth"
    kind = "sensor_msgs/msg/CompressedImage"
    png = cv2.imencode(".png", frame.rgb[..., ::-1])[1].tobytes()
    units = bytes(12) + cv2.imencode(".png", np.rint(frame.depth * 1000).astype(np.uint16))[1].tobytes()
    with McapFile(tmp_path / "a.mcap") as out:
        out.write(INFO, camera_info_message(1.0, frame.camera), 10**9)
        out.write(color, build(kind, header=head, format="rgb8; png compressed bgr8", data=png), 10**9)
        out.write(depth, build(kind, header=head, format="16UC1; compressedDepth png", data=units), 10**9)
    back = open_log(tmp_path / "a.mcap")[0]
    np.testing.assert_array_equal(back.rgb, frame.rgb)
    np.testing.assert_allclose(back.depth, frame.depth, atol=0.0005)


def _write(path: Path, frame: Frame, *, cameras: int = 1, depth: bool = True, info: bool = True) -> Path:
    with McapFile(path) as out:
        for i in range(cameras):
            prefix = f"/cam{i}"
            out.write(f"{prefix}/color", image_message(frame.stamp, frame.rgb), 1)
            if depth:
                out.write(f"{prefix}/depth", image_message(frame.stamp, frame.depth + i), 1)
            if info:
                out.write(f"{prefix}/camera_info", camera_info_message(frame.stamp, frame.camera), 1)
    return path


def test_of_several_cameras_one_is_named_in_the_uri(make_log: MakeLog, tmp_path: Path) -> None:
    frame = open_log(make_log())[0]
    path = _write(tmp_path / "a.mcap", frame, cameras=2)
    with pytest.raises(LogError, match=r"several color topics .*a.mcap\?color=TOPIC"):
        open_log(path)
    log = open_log(f"{path}?color=/cam1/color&depth=/cam1/depth")
    np.testing.assert_array_equal(log[0].depth, frame.depth + 1)
    assert open_log(log.uri)[0].stamp == log[0].stamp
    with pytest.raises(LogError, match="no topic /cam7"):
        open_log(f"{path}?color=/cam7")
    with pytest.raises(LogError, match="no option 'colour'"):
        open_log(f"{path}?colour=/cam1/color")


@pytest.mark.parametrize(("lacks", "message"), [("depth", "no depth images"), ("info", "camera")])
def test_missing_parts_of_a_recording_are_named(lacks: str, message: str, make_log: MakeLog, tmp_path: Path) -> None:
    frame = open_log(make_log())[0]
    path = _write(tmp_path / "a.mcap", frame, **{lacks: False})
    with pytest.raises(LogError, match=message):
        open_log(path)


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_a_recording_that_is_cut_off_is_an_error_that_names_the_file(
    keep: float, make_log: MakeLog, tmp_path: Path
) -> None:
    data = record_mcap(open_log(make_log()), tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[: int(keep * len(data))])
    with pytest.raises(LogError, match=r"b.mcap"):
        list(open_log(tmp_path / "b.mcap"))


def test_flipped_bytes_raise_nothing_but_log_errors(make_log: MakeLog, tmp_path: Path) -> None:
    data = record_mcap(open_log(make_log(2)), tmp_path / "a.mcap").read_bytes()
    rng, failed = np.random.default_rng(3), 0
    for i in range(60):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            damaged[at] ^= int(rng.integers(1, 256))
        path = tmp_path / f"{i}.mcap"
        path.write_bytes(damaged)
        try:
            list(open_log(path))
        except LogError:
            failed += 1
        path.unlink()
    assert failed >= 10


def test_a_recording_never_overwrites_and_has_its_name_only_when_complete(make_log: MakeLog, tmp_path: Path) -> None:
    frame = open_log(make_log())[0]
    out = McapFile(tmp_path / "a.mcap")
    out.write(COLOR, image_message(0.0, frame.rgb), 0)
    assert not (tmp_path / "a.mcap").exists()
    out.close()
    assert [p.name for p in tmp_path.glob("*a.mcap*")] == ["a.mcap"]
    with pytest.raises(LogError, match="exists already"):
        McapFile(tmp_path / "a.mcap")


def test_a_free_running_depth_camera_is_paired_by_time_and_lone_images_are_counted(
    make_log: MakeLog, tmp_path: Path
) -> None:
    log = open_log(make_log())
    with McapFile(tmp_path / "a.mcap") as out:
        for frame in log:
            ns = round(frame.stamp * 1e9)
            out.write(INFO, camera_info_message(frame.stamp, frame.camera), ns)
            out.write(COLOR, image_message(frame.stamp, frame.rgb), ns)
            if frame.index != 2:
                late = replace(frame, stamp=frame.stamp + 0.01)
                out.write(DEPTH, image_message(late.stamp, late.depth), ns + 10**7)
    back = BagLog(tmp_path / "a.mcap")
    assert (len(back), back.unpaired) == (4, 1)
    assert [f.stamp for f in back] == pytest.approx([f.stamp for f in log if f.index != 2])
