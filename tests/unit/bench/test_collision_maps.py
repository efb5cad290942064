"""The fused reference of recorded maps: the surface where it was measured, without what one image alone has seen."""

from __future__ import annotations

import numpy as np

from splatbot.bench.collision_maps import _DepthFusion
from splatbot.frame import Frame
from splatbot.geometry import se3_exp
from tests.rgbd import CAMERA, wall_depth


def test_fused_depth_is_the_wall_at_its_place_and_leaves_strays_out() -> None:
    fusion, noise = _DepthFusion(), np.random.default_rng(0)
    for k in range(8):
        T = se3_exp([0.02 * k, 0.0, 0.0, 0.0, 0.01 * k, 0.0])
        depth = wall_depth(CAMERA, T, (0.1, 0.0, 1.0), 1.5).astype(np.float32)
        depth += noise.normal(0, 0.004, depth.shape).astype(np.float32)
        depth[:10] = np.nan
        if k == 3:
            depth[50:53, 70:73] = 0.8
        fusion.add(Frame(k / 30, np.zeros((120, 160, 3), np.uint8), depth, CAMERA, k), T)
    points = fusion.surface()
    normal = np.array([0.1, 0.0, 1.0])
    off = (points @ normal - 1.5) / np.linalg.norm(normal)
    assert len(points) > 2000
    assert abs(float(np.median(off))) < 1e-3
    assert float(np.abs(off).max()) < 0.05
