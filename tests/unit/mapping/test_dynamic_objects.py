"""Dynamic objects are mapped once they stay and not while they move; removed objects leave the map."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from splatbot.frame import Frame
from splatbot.geometry import inverse
from splatbot.logs import open_log
from splatbot.logs.synthetic import SyntheticLog
from splatbot.mapping.insertion import view_of
from splatbot.mapping.mapper import Mapper
from splatbot.slam import Slam
from tests.rgbd import CAMERA, small_config, wall_frame
from tests.unit.mapping.conftest import insert, observe, should_insert

EACH_FRAME = small_config(mapping__observe_interval_s=0)


def with_object(frame: Frame, u: int, depth: float = 0.6, half: int = 15) -> Frame:
    """Return a frame with a dark square in front of the wall."""
    rgb, z = frame.rgb.copy(), frame.depth.copy()
    rgb[60 - half : 60 + half, u - half : u + half] = (20, 20, 60)
    z[60 - half : 60 + half, u - half : u + half] = depth
    return replace(frame, rgb=rgb, depth=z)


def show(mapper: Mapper, frame: Frame, stamp: float, *, keyframe: bool = False) -> None:
    (insert if keyframe else observe)(mapper, replace(frame, stamp=stamp))


def nearer_than(mapper: Mapper, depth: float) -> int:
    return int(((mapper.model.means[:, 2] < depth) & (mapper.model.opacities > 0.05)).sum())


def test_an_object_that_passes_through_free_space_enters_neither_map_nor_reference() -> None:
    mapper, wall = Mapper(EACH_FRAME), wall_frame(np.eye(4))
    show(mapper, wall, 0.0, keyframe=True)
    before = len(mapper.model)
    show(mapper, with_object(wall, 80), 0.3, keyframe=True)
    assert nearer_than(mapper, 0.8) == 0
    assert len(mapper.model) < 1.02 * before
    keyframe = mapper.keyframes[-1]
    assert keyframe.static_mask is not None
    assert not keyframe.static_mask[50:70, 70:90].any()
    assert keyframe.static_mask[:, :40].all()
    for level in keyframe.reference.levels:
        assert level.points[:, 2].min() > 0.9


def test_an_object_that_has_stayed_for_a_second_is_mapped() -> None:
    mapper, wall = Mapper(EACH_FRAME), wall_frame(np.eye(4))
    show(mapper, wall, 0.0, keyframe=True)
    for k in range(6):
        show(mapper, with_object(wall, 80), 0.2 + 0.2 * k)
    assert nearer_than(mapper, 0.8) == 0
    show(mapper, with_object(wall, 80), 1.4, keyframe=True)
    assert nearer_than(mapper, 0.8) > 50


def test_an_object_that_keeps_moving_is_never_mapped() -> None:
    mapper, wall = Mapper(EACH_FRAME), wall_frame(np.eye(4))
    show(mapper, wall, 0.0, keyframe=True)
    for k in range(12):
        show(mapper, with_object(wall, 30 + 9 * k, half=10), 0.2 + 0.2 * k, keyframe=k % 4 == 3)
    assert nearer_than(mapper, 0.8) == 0


def test_a_new_object_in_space_never_seen_is_mapped_at_once() -> None:
    mapper, wall = Mapper(EACH_FRAME), wall_frame(np.eye(4))
    masked = replace(wall, depth=np.where(np.arange(160) < 90, wall.depth, np.float32(0)).astype(np.float32))
    show(mapper, masked, 0.0, keyframe=True)
    show(mapper, with_object(wall, 125), 0.3, keyframe=True)
    assert nearer_than(mapper, 0.8) > 50


def test_a_removed_object_leaves_no_ghost_after_a_second_and_the_surface_behind_it_makes_a_keyframe() -> None:
    mapper, wall = Mapper(EACH_FRAME), wall_frame(np.eye(4))
    show(mapper, with_object(wall, 80), 0.0, keyframe=True)
    assert nearer_than(mapper, 0.8) > 50
    for k in range(5):
        show(mapper, wall, 0.2 + 0.2 * k)
    assert nearer_than(mapper, 0.8) == 0
    assert should_insert(mapper, wall)
    show(mapper, wall, 1.2, keyframe=True)
    assert not should_insert(mapper, wall)
    view = view_of(mapper.model, CAMERA, np.eye(4))
    assert float((view.depth - 1.0).abs().max()) < 0.02
    assert float(view.rgb[50:70, 70:90].mean()) > 0.35  # the colors of the wall, not of the dark object


def test_a_hand_that_crosses_leaves_no_trace_in_the_map_and_tracking_goes_on() -> None:
    log = open_log("synthetic:tabletop_crossing?width=160&height=120&frames=60&rate=15&event=0.8")
    assert isinstance(log, SyntheticLog)
    slam = Slam(small_config(mapping__refine_iterations=4))
    truth = [inverse(log.ground_truth.T_world_camera[0]) @ T for T in log.ground_truth.T_world_camera]
    for frame, T in zip(log, truth, strict=True):
        result = slam.process(frame)
        assert result.T_world_camera is not None, frame.index
        assert np.linalg.norm(result.T_world_camera[:3, 3] - T[:3, 3]) < 8e-3, frame.index
    last = log[len(log) - 1]
    view = view_of(slam.snapshot().model, last.camera, truth[-1])
    ghost = (last.depth > 0) & (view.depth.numpy() < 0.85 * last.depth) & (view.alpha.numpy() > 0.5)
    solid = cv2.morphologyEx(ghost.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    assert not solid.any()  # edges of objects are soft by a pixel, a hand is 20 pixels wide


def test_pixels_that_a_frame_s_mask_excludes_are_neither_mapped_nor_guessed() -> None:
    mapper, wall = Mapper(EACH_FRAME), wall_frame(np.eye(4))
    mask = np.ones((120, 160), dtype=np.bool_)
    mask[40:80, 60:100] = False
    show(mapper, replace(wall, mask=mask), 0.0, keyframe=True)
    u, v = CAMERA.project(mapper.model.means.double().numpy()).T
    assert len(mapper.model) > 1000
    assert not ((u > 62) & (u < 98) & (v > 42) & (v < 78)).any()
