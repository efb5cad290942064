"""Transforms of /tf and /tf_static at the time of an image."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from splatbot.logs.ros_transforms import StampedTransform
from splatbot.mapping.selfmask import JointsUnknownError
from splatbot.robots.tf_buffer import MAX_FRAMES, MAX_TRANSFORMS, TransformBuffer

Array = NDArray[np.float64]


def stamped(parent: str, child: str, stamp: float, x: float = 0.0, *, static: bool = False) -> StampedTransform:
    return StampedTransform(parent, child, stamp, np.array([x, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), static)


def buffer(*transforms: StampedTransform) -> TransformBuffer:
    known = TransformBuffer()
    known.add(transforms)
    return known


def matrix(translation: Array, rotation: Rotation) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), translation
    return T


def test_poses_along_a_chain_are_those_of_scipys_slerp() -> None:
    rng = np.random.default_rng(3)
    stamps = 1.7e9 + np.arange(6) * 0.05
    # world has base (moving), which has camera_mount (moving) with camera (static), and link (moving).
    edges = {"base": "world", "camera_mount": "base", "link": "base"}
    places = {child: rng.normal(size=(6, 3)) for child in edges}
    turns = {child: Rotation.random(6, random_state=k) for k, child in enumerate(edges)}
    fixed = matrix(rng.normal(size=3), Rotation.random(random_state=9))
    known = TransformBuffer()
    for child, parent in edges.items():
        quats = turns[child].as_quat()[:, [3, 0, 1, 2]] * rng.choice([-1.0, 1.0], size=(6, 1))  # both mean one rotation
        known.add(StampedTransform(parent, child, *row) for row in zip(stamps, places[child], quats, strict=True))
    quat = Rotation.from_matrix(fixed[:3, :3]).as_quat()[[3, 0, 1, 2]]
    known.add([StampedTransform("camera_mount", "camera", 0.0, fixed[:3, 3], quat, static=True)])
    for stamp in rng.uniform(stamps[0], stamps[-1], 50):
        at = {
            child: matrix(
                np.array([np.interp(stamp, stamps, column) for column in places[child].T]),
                Slerp(stamps - stamps[0], turns[child])(stamp - stamps[0]),
            )
            for child in edges
        }
        found = known.poses("camera", ["link", "base", "world", "camera"], stamp)
        T_base_camera = at["camera_mount"] @ fixed
        np.testing.assert_allclose(found[0], np.linalg.inv(T_base_camera) @ at["link"], atol=1e-6)
        np.testing.assert_allclose(found[1], np.linalg.inv(T_base_camera), atol=1e-6)
        np.testing.assert_allclose(found[2], np.linalg.inv(at["base"] @ T_base_camera), atol=1e-6)
        np.testing.assert_allclose(found[3], np.eye(4), atol=1e-9)


def test_poses_are_exact_where_the_stamps_are_and_small_turns_are_interpolated_too() -> None:
    half = 1e-10
    small = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    known = buffer(
        StampedTransform("a", "b", 0.0, np.zeros(3), identity), StampedTransform("a", "b", 0.08, np.ones(3), small)
    )
    np.testing.assert_array_equal(known.poses("a", ["b"], 0.0)[0], np.eye(4))
    np.testing.assert_allclose(known.poses("a", ["b"], 0.02)[0][:3, 3], 0.25, atol=1e-12)


@pytest.mark.parametrize(
    ("stamps", "image"),
    [((1.0,), 1.01), ((1.0,), 0.99), ((1.0, 1.25), 1.12), ((1.0, 1.11), 1.005), ((1e9,), 1.0)],
    ids=["none after", "none before", "far apart", "next too late", "another clock"],
)
def test_a_moving_frame_that_is_stale_is_refused_and_a_static_one_has_no_age(
    stamps: tuple[float, ...], image: float
) -> None:
    known = buffer(*(stamped("base", "link", t) for t in stamps), stamped("base", "camera", 500.0, static=True))
    with pytest.raises(JointsUnknownError, match=r"TF of link .* missing or stale"):
        known.poses("camera", ["link"], image)
    np.testing.assert_array_equal(known.poses("camera", ["base"], image)[0], np.eye(4))


def test_frames_that_are_missing_or_not_connected_are_named_with_those_of_another_prefix() -> None:
    known = buffer(stamped("base", "camera", 0.0, static=True), stamped("map", "left_link1", 0.0, static=True))
    with pytest.raises(JointsUnknownError, match="no frame link1, link2") as missing:
        known.poses("camera", ["base", "link1", "link2"], 0.0)
    assert "left_link1" in str(missing.value.hint)
    with pytest.raises(JointsUnknownError, match="does not connect left_link1 with camera"):
        known.poses("camera", ["base", "left_link1"], 0.0)
    with pytest.raises(JointsUnknownError, match="no frame camera, link"):
        TransformBuffer().poses("camera", ["link"], 0.0)


def test_a_stale_edge_above_both_frames_does_not_count() -> None:
    known = buffer(stamped("map", "base", 0.0), *(stamped("base", f, 9.0 + t) for f in ("a", "b") for t in (0.0, 0.05)))
    assert known.poses("a", ["b"], 9.02).shape == (1, 4, 4)
    loop = buffer(stamped("a", "b", 0.0, static=True), stamped("b", "a", 0.0, static=True))
    assert loop.newest("a", "c") is None


def test_a_transform_after_the_image_is_waited_for_and_no_longer_than_given() -> None:
    known = buffer(stamped("base", "link", 1.0))
    threading.Timer(0.05, lambda: known.add([stamped("base", "link", 1.05, 1.0)])).start()
    np.testing.assert_allclose(known.poses("base", ["link"], 1.03, 5.0)[0][0, 3], 0.6, atol=1e-9)
    begin = time.monotonic()
    with pytest.raises(JointsUnknownError):
        known.poses("base", ["link"], 1.07, 0.1)
    assert time.monotonic() - begin >= 0.1


def test_a_clock_that_is_set_back_forgets_what_moves() -> None:
    known = buffer(stamped("base", "camera", 100.0, static=True), stamped("base", "link", 100.0))
    known.add([stamped("base", "link", 100.05), stamped("base", "other", 100.0)])
    known.add([stamped("base", "link", 99.9)])  # a late one
    assert known.poses("camera", ["link"], 100.02).shape == (1, 4, 4)
    known.add([stamped("base", "link", 5.0)])
    with pytest.raises(JointsUnknownError):
        known.poses("camera", ["link"], 100.02)
    assert len(known) == 2
    assert known.poses("camera", ["link"], 5.0).shape == (1, 4, 4)


def test_a_frame_that_changes_its_parent_starts_over() -> None:
    known = buffer(*(stamped("base", "cup", t, 1.0) for t in (0.0, 0.05)), *(stamped("hand", "cup", 0.1),) * 2)
    with pytest.raises(JointsUnknownError, match="no frame base"):
        known.poses("base", ["cup"], 0.02)
    assert known.carrier("cup", ["base", "hand"]) == "hand"
    assert known.carrier("cup", ["base"]) is None


def test_fixed_transforms_are_those_of_static_edges_alone() -> None:
    known = buffer(
        stamped("mount", "color", 0.0, 0.1, static=True),
        stamped("mount", "depth", 0.0, 0.3, static=True),
        stamped("mount", "pan", 0.0, 0.5),
    )
    found = known.fixed("color", "depth")
    assert found is not None
    np.testing.assert_allclose(found[:3, 3], [0.2, 0, 0], atol=1e-12)
    assert known.fixed("color", "pan") is None
    assert known.fixed("color", "elsewhere") is None


def test_memory_is_bounded_in_frames_time_and_size() -> None:
    known = TransformBuffer()
    known.add(stamped("base", f"f{k}", 0.0, static=True) for k in range(MAX_FRAMES + 100))
    assert len(known) == MAX_FRAMES
    known = buffer(*(stamped("base", "link", k * 0.01) for k in range(3000)))
    assert len(known) == 1001  # 10 s
    known = TransformBuffer()
    for k in range(MAX_TRANSFORMS // MAX_FRAMES + 50):
        known.add(stamped("base", f"f{n}", k * 1e-3) for n in range(MAX_FRAMES))
    assert len(known) == MAX_FRAMES * (MAX_TRANSFORMS // MAX_FRAMES)


def test_transforms_that_are_no_pose_are_left_out() -> None:
    known = TransformBuffer()
    good = stamped("base", "link", 1.0)
    for translation, quat in (
        ([np.nan, 0, 0], [1, 0, 0, 0]),
        ([1e9, 0, 0], [1, 0, 0, 0]),
        ([0, 0, 0], [0, 0, 0, 0]),
        ([0, 0, 0], [np.inf, 0, 0, 0]),
    ):
        known.add([StampedTransform("base", "link", 1.0, np.array(translation, float), np.array(quat, float)), good])
    known.add([stamped("a", "a", 1.0), stamped("", "b", 1.0), stamped("a", "b" * 300, 1.0), stamped("a", "b", np.nan)])
    assert len(known) == 1
    known.add([StampedTransform("base", "link", 1.05, np.zeros(3), np.array([0.0, 0.0, 0.0, 1e200]))])
    np.testing.assert_allclose(known.poses("base", ["link"], 1.05)[0], np.diag([-1.0, -1.0, 1.0, 1.0]), atol=1e-12)
