"""Colour and depth of two cameras of ROS topics, against exact projections and OpenCV's distortion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.geometry import se3_exp, transform_points
from splatbot.logs.ros_cameras import CameraPair, RosCameras
from splatbot.protocols import Array

DEPTH = Camera(60.0, 61.0, 31.5, 23.5, 64, 48)
COLOR = Camera(130.0, 131.0, 66.0, 47.0, 132, 96)
T_COLOR_DEPTH = se3_exp([0.05, -0.02, 0.01, 0.02, -0.03, 0.01])
BENT = (0.1, -0.05, 0.002, -0.001)


def ramp(camera: Camera) -> NDArray[np.uint8]:
    """Return an image whose red and green grow linearly with the column and row."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([u, 2 * v, np.full_like(u, 7)], axis=-1).astype(np.uint8)


def cameras(find: dict[tuple[str, str], Array], *, depth: Camera | None = DEPTH, frame: str = "depth") -> RosCameras:
    found = RosCameras(lambda target, source: find.get((target, source)))
    found.color = COLOR
    if depth is not None:
        found.set_depth(depth, frame)
    return found


@pytest.mark.parametrize("distortion", [(), BENT])
def test_each_depth_pixel_has_the_colour_of_its_projection_into_the_distorted_colour_camera(
    distortion: tuple[float, ...],
) -> None:
    z = np.random.default_rng(0).uniform(0.5, 3.0, (48, 64)).astype(np.float32)
    rgb, depth = CameraPair(replace(COLOR, distortion=distortion), DEPTH, T_COLOR_DEPTH).images(ramp(COLOR), z)
    points = transform_points(T_COLOR_DEPTH, DEPTH.backproject(z)).reshape(-1, 1, 3)
    bent = np.array(distortion or (0.0,) * 4)
    uv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), COLOR.K, bent)[0].reshape(48, 64, 2)
    inside = ((uv > 5) & (uv < np.array([COLOR.width, COLOR.height]) - 6)).all(-1)
    assert inside.mean() > 0.6
    np.testing.assert_allclose(rgb[inside][:, :2], uv[inside] * [1, 2], atol=2.5)
    np.testing.assert_array_equal(depth[inside], z[inside])


def test_images_of_one_camera_stay_as_they_are() -> None:
    rgb, z = ramp(COLOR), np.ones((96, 132), np.float32)
    for frames in (("", ""), ("a", "a"), ("", "a"), ("a", "")):
        for depth in (None, COLOR, DEPTH):  # a driver that aligns depth may also publish the camera_info of raw depth
            pair = cameras({}, depth=depth).pair(*frames, same_size=True)
            found = pair.images(rgb, z)
            assert pair.camera == COLOR
            assert found[0] is rgb
            assert found[1] is z


def test_depth_of_another_size_in_the_same_frame_is_a_second_camera_at_the_same_place() -> None:
    pair = cameras({}, depth=COLOR.resized(66, 48), frame="a").pair("a", "a", same_size=False)
    rgb, _ = pair.images(ramp(COLOR), np.ones((48, 66), np.float32))
    assert pair.camera == COLOR.resized(66, 48)
    np.testing.assert_allclose(rgb[..., 0], np.mgrid[:48, :66][1] * 2 + 0.5, atol=0.51)


def test_the_transform_between_the_frames_counts_and_the_pair_is_kept_until_something_changes() -> None:
    found = {("color", "depth"): T_COLOR_DEPTH}
    known = cameras(found)
    pair = known.pair("color", "depth", same_size=False)
    np.testing.assert_array_equal(pair.T_color_depth, T_COLOR_DEPTH)
    assert known.pair("color", "depth", same_size=False) is pair
    found["color", "depth"] = np.eye(4)
    moved = known.pair("color", "depth", same_size=False)
    assert moved is not pair
    known.set_depth(DEPTH.resized(32, 24), "depth")
    assert known.pair("color", "depth", same_size=False).camera == DEPTH.resized(32, 24)


def test_depth_of_another_camera_is_refused_where_its_intrinsics_or_its_place_are_not_known() -> None:
    with pytest.raises(InputError, match="depth: is of depth_optical, colour of color_optical, and depth") as one:
        cameras({}, depth=None).pair("color_optical", "depth_optical", same_size=True)
    assert "camera_info" in str(one.value.hint)
    with pytest.raises(InputError, match="TF does not connect") as other:
        cameras({}, frame="depth_optical").pair("color_optical", "depth_optical", same_size=True)
    assert "/tf_static" in str(other.value.hint)
    with pytest.raises(InputError, match="has a camera_info of depth"):  # of raw depth, not of these images
        cameras({}).pair("color_optical", "aligned", same_size=True)
    for frames in (("", ""), ("a", "")):
        with pytest.raises(InputError, match="of another size"):
            cameras({}).pair(*frames, same_size=False)
    pair = cameras({}, frame="a").pair("a", "a", same_size=False)
    with pytest.raises(InputError, match="depth image: is 132x96, its camera_info 64x48"):
        pair.images(ramp(COLOR), np.ones((96, 132), np.float32))
