"""Recordings of ROS topics whose depth is of another camera than colour: rosbags writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.logs import open_log
from splatbot.logs.ros_frames import camera_info_message, image_message
from splatbot.logs.ros_types import to_cdr
from tests.ros_recording import IMAGE, TF, transforms

W, H, F = 64, 48, 64.0
CAMERA = Camera(F, F, 31.5, 23.5, W, H)
SHIFT = 8  # [px] of a plane at 1 m between both cameras, 0.125 m apart


def record(
    path: Path, *, depth_frame: str = "depth", depth_info: Camera | None = CAMERA, tf: bool = True, size: int = 1
) -> str:
    """Record one frame of a plane at 1 m, whose colour is the column of the colour camera."""
    store = get_typestore(Stores.ROS2_JAZZY)
    rgb = np.repeat(np.tile(np.arange(W, dtype=np.uint8) * 2, (H, 1))[:, :, None], 3, axis=2)
    with Writer(path, version=9) as writer:

        def write(topic: str, kind: str, message: object) -> None:
            writer.write(writer.add_connection(topic, kind, typestore=store), 10**9, to_cdr(message))

        if tf:  # a point of depth is 0.125 m farther right in colour; the chain has two edges
            T_mount_color, T_mount_depth = np.eye(4), np.eye(4)
            T_mount_color[0, 3], T_mount_depth[0, 3] = -0.1, 0.025
            edges = [("mount", "color", T_mount_color), ("mount", "depth", T_mount_depth)]
            write("/tf_static", TF, transforms(1.0, edges))
        write("/cam/color/camera_info", "sensor_msgs/msg/CameraInfo", camera_info_message(1.0, CAMERA))
        write("/cam/color/image_raw", IMAGE, image_message(1.0, rgb, "color"))
        if depth_info is not None:
            write("/cam/depth/camera_info", "sensor_msgs/msg/CameraInfo", camera_info_message(1.0, depth_info, "depth"))
        z = np.ones((H // size, W // size), np.float32)
        write("/cam/depth/image_rect_raw", IMAGE, image_message(1.0, z, depth_frame))
    return str(path)


def test_colour_is_at_the_pixels_of_depth_by_the_recorded_cameras_and_tf(tmp_path: Path) -> None:
    frame = open_log(record(tmp_path / "bag"))[0]
    u = np.arange(W - SHIFT)
    np.testing.assert_array_equal(frame.rgb[:, : W - SHIFT, 0], np.tile(2 * (u + SHIFT), (H, 1)))
    assert (frame.depth[:, : W - SHIFT] == 1).all()
    assert (frame.depth[:, W - SHIFT :] == 0).all()  # the colour camera does not see these
    assert frame.camera == CAMERA


def test_depth_of_half_the_size_has_colour_of_its_own_pixels(tmp_path: Path) -> None:
    half = Camera(F / 2, F / 2, 15.5, 11.5, W // 2, H // 2)
    log = open_log(record(tmp_path / "bag", depth_info=half, size=2))
    assert (log.camera, log[0].rgb.shape[:2]) == (half, (H // 2, W // 2))


@pytest.mark.parametrize("missing", ["camera_info", "TF"])
def test_depth_of_an_unknown_camera_is_refused_unless_it_is_stated_to_be_registered(
    tmp_path: Path, missing: str
) -> None:
    path = record(tmp_path / "bag", depth_info=None if missing == "camera_info" else CAMERA, tf=missing != "TF")
    with pytest.raises(LogError, match=missing) as caught:
        open_log(path)
    assert "?registered=1" in str(caught.value.hint)
    frame = open_log(f"{path}?registered=1")[0]
    np.testing.assert_array_equal(frame.rgb[0, :, 0], 2 * np.arange(W))
    assert (frame.depth == 1).all()


def test_depth_of_the_frame_of_colour_stays_at_its_pixels(tmp_path: Path) -> None:
    frame = open_log(record(tmp_path / "bag", depth_frame="color"))[0]
    np.testing.assert_array_equal(frame.rgb[0, :, 0], 2 * np.arange(W))
