"""The splat stage converges to the pose at which the map renders the frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.splat_stage import align_to_map, compare
from splatbot.geometry import se3_exp
from splatbot.rasterize.views import render_view
from splatbot.slam import Slam
from splatbot.tracking.prepare import prepare
from splatbot.tracking.tracker import pose_distance
from tests.rgbd import small_config, tabletop


def test_a_view_of_the_map_itself_is_found_from_millimetres_away() -> None:
    frames, poses = tabletop()
    slam = Slam(small_config())
    for frame in frames[:4]:
        slam.process(frame)
    model, T = slam.snapshot().model, poses[3]
    rgb = np.rint(255 * render_view(model, frames[0].camera, T)).astype(np.uint8)
    seen = replace(frames[3], rgb=rgb, depth=render_view(model, frames[0].camera, T, "depth"))
    start = T @ se3_exp(np.array([0.004, -0.003, 0.002, 0.003, 0.002, -0.002]))
    found, _ = align_to_map(model, prepare(seen, slam.config.tracking), start, slam.config)
    moved, turned = pose_distance(T, found)
    assert moved < 5e-4
    assert turned < 5e-4


def test_both_stages_are_scored_on_the_same_frames() -> None:
    found = compare("synthetic:tabletop?width=160&height=120&frames=4", small_config())
    assert found.frames == 3
    assert 0 < found.direct_m < 2e-3
    assert 0 < found.splat_m < 1e-2
    assert min(found.direct_ms, found.splat_min_ms) > 0
