"""A wrist and a fixed camera together map a scene no worse than the better one of them alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.config import Config, MappingConfig
from splatbot.frame import Frame
from splatbot.mapping.further_camera import MountedCamera
from splatbot.mapping.insertion import view_of
from splatbot.slam import Slam
from splatbot.tracking.nearby_keyframes import pose_distance
from tests.several_cameras import WRONG, estimated, frames_of, in_order, in_world, side_view, wrist_log

FRAMES = 24
MISSING = 0.05
"""Error [m] of a pixel where the map has no surface, and the largest error that counts."""


@pytest.mark.long
def test_a_wrong_extrinsic_is_recovered_and_the_joint_map_is_no_worse_than_the_better_single_one() -> None:
    log = wrist_log(FRAMES, width=640, height=480, effects="depth_noise;color_noise")
    T = side_view(log, np.radians(40), 0.1)
    stamps = [k / 30 + 0.01 for k in range(FRAMES)]
    table = frames_of(log, [T] * FRAMES, stamps, "table", width=1280, height=720, sigma_depth=0.002)
    first = [Frame(f.stamp, f.rgb, f.depth, f.camera, f.index) for f in table]
    T_world_table = in_world(log, T)

    short = MappingConfig(final_iterations=60)
    cameras = {"table": estimated(T_world_table @ WRONG, fixed=True)}
    joint = mapped(in_order(log, table), Config(cameras=cameras, mapping=short))
    camera = joint.further_cameras["table"]
    assert isinstance(camera, MountedCamera)
    assert camera.pose.known
    moved, turned = pose_distance(T_world_table, camera.pose.T_parent_camera)
    assert moved < 2e-3
    assert turned < np.radians(0.2)

    wrist_poses = [in_world(log, pose) for pose in log.ground_truth.T_world_camera]
    truth = wrist_log(FRAMES, width=640, height=480)
    views = [(truth[k], wrist_poses[k]) for k in (0, FRAMES // 2, FRAMES - 1)]
    views += [(frames_of(log, [T], [0.0], "table", width=1280, height=720)[0], T_world_table)]
    both = depth_error(joint, views, np.eye(4))
    by_wrist = depth_error(mapped(list(log), Config(mapping=short)), views, np.eye(4))
    by_table = depth_error(mapped(first, Config(mapping=short)), views, T_world_table)
    print(f"depth error {1e3 * both:.2f} mm, by the wrist {1e3 * by_wrist:.2f}, by the table {1e3 * by_table:.2f}")
    assert both <= min(by_wrist, by_table)


def mapped(frames: Sequence[Frame], config: Config) -> Slam:
    slam = Slam(config)
    for frame in frames:
        slam.process(frame)
    slam.finish()
    return slam


def depth_error(
    slam: Slam, views: Sequence[tuple[Frame, NDArray[np.float64]]], T_world_map: NDArray[np.float64]
) -> float:
    """Return the mean error of depth [m] over all pixels of views at their true poses.

    Args:
        slam: the map.
        views: exact frames and their T_world_camera (4, 4).
        T_world_map: (4, 4) world of the map in that of the poses.
    """
    model, errors = slam.snapshot().model, []
    for frame, T in views:
        view = view_of(model, frame.camera, np.linalg.inv(T_world_map) @ T)
        seen = (view.alpha.numpy() > 0.5) & (frame.depth > 0)
        error = np.where(seen, np.abs(view.depth.numpy() - frame.depth), MISSING)
        errors.append(np.minimum(error, MISSING)[frame.depth > 0].mean())
    return float(np.mean(errors))
