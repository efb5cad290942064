"""Scenes: exact depth and poses, texture with corners where intended, and moving objects at their exact poses."""

from __future__ import annotations

import tracemalloc

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.geometry import inverse, transform_points
from splatbot.logs import open_log
from splatbot.logs.scenes import SCENES
from splatbot.logs.synthetic import SyntheticLog
from splatbot.logs.trajectories import TRAJECTORIES

SIZE = "width=160&height=120"


def synthetic(query: str) -> SyntheticLog:
    log = open_log(f"synthetic:{query}")
    assert isinstance(log, SyntheticLog)
    return log


def world_points(log: SyntheticLog, index: int) -> NDArray[np.float64]:
    """Backproject frame ``index`` to world points (N, 3) [m] in float64."""
    frame, c = log[index], log.camera
    v, u = np.nonzero(frame.valid)
    z = frame.depth[v, u].astype(np.float64)
    points = np.column_stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z])
    return transform_points(log.ground_truth.T_world_camera[index], points)


@pytest.mark.parametrize("name", SCENES)
def test_two_frames_agree_on_where_a_point_is_to_10_micrometres(name: str) -> None:
    """A point of one frame is visible from the other camera at the same position, unless it is occluded."""
    log = synthetic(f"{name}?frames=60&{SIZE}")
    seen = world_points(log, 20)
    eye = log.ground_truth.T_world_camera[40, :3, 3]
    share = log.scene.reach(eye, seen - eye, float(log.ground_truth.stamps[40]))
    error = np.abs(share - 1.0) * np.linalg.norm(seen - eye, axis=1)
    clear = error < 1e-3
    assert clear.mean() > 0.8  # the others are occluded
    assert error[clear].max() < 1e-5


def test_every_scene_shows_depth_everywhere_on_every_path_that_fits() -> None:
    for name, kind in SCENES.items():
        for path in kind.stage.paths or TRAJECTORIES:
            log = synthetic(f"{name}?trajectory={path}&frames=90&width=32&height=24")
            depth = np.stack([log[i].depth for i in range(0, 90, 10)])
            assert depth[depth > 0].min() > 0.2, (name, path)  # no camera is inside of an object
            assert depth.max() < 13.1, (name, path)  # the range of 16 bits
            assert np.mean(depth > 0) > 0.95, (name, path)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("wall", 300, 1000), ("room", 100, 1000), ("corridor", 300, 1000), ("wall_soft", 0, 0), ("wall_blank", 0, 0)],
)
def test_texture_is_one_that_orb_can_use_or_not(name: str, low: int, high: int) -> None:
    orb = cv2.ORB.create(1000)
    found = [len(orb.detect(frame.rgb)) for frame in synthetic(f"{name}?frames=4&width=320&height=240")]
    assert min(found) >= low
    assert max(found) <= high


def test_a_soft_wall_has_colours_and_a_blank_one_does_not() -> None:
    assert np.ptp(synthetic(f"wall_soft?{SIZE}")[0].rgb) > 20
    assert np.ptp(synthetic(f"wall_blank?{SIZE}")[0].rgb.reshape(-1, 3), axis=0).max() == 0


def test_a_crossing_hand_is_where_it_is_said_to_be_and_nowhere_before_and_after() -> None:
    log, still = synthetic(f"tabletop_crossing?event=0.5&frames=120&{SIZE}"), synthetic(f"tabletop?frames=120&{SIZE}")
    path = log.objects()["hand"]
    assert path.stamps[0] == pytest.approx(0.5)
    assert path.stamps[-1] == pytest.approx(3.0)
    for i in (5, 110):
        assert not log.moving_mask(i).any()
        assert np.array_equal(log[i].rgb, still[i].rgb)
    for i in (45, 52, 59):
        mask = log.moving_mask(i)
        assert 0.02 < mask.mean() < 0.15
        frame, without = log[i], still[i]
        assert np.array_equal(frame.depth[~mask], without.depth[~mask])
        assert (frame.depth[mask] < without.depth[mask]).all()
        T_world_hand = path.T_world_camera[np.argmin(np.abs(path.stamps - frame.stamp))]
        T_hand_camera = inverse(T_world_hand) @ log.ground_truth.T_world_camera[i]
        points = transform_points(T_hand_camera, log.camera.backproject(frame.depth)[mask])
        assert (points > [-0.0501, -0.0451, -1e-4]).all()
        assert (points < [0.1301, 0.0451, 0.0301]).all()


def test_a_hand_takes_its_texture_along() -> None:
    log = synthetic("tabletop_crossing?event=0&frames=80&width=320&height=240")
    colors = [log[i].rgb[log.moving_mask(i)].astype(float) for i in (30, 45)]
    np.testing.assert_allclose(colors[0].mean(axis=0), colors[1].mean(axis=0), atol=6)
    assert colors[0].std() > 5


def test_a_removed_carton_is_gone_from_the_event_on() -> None:
    log = synthetic(f"tabletop_removed?event=1&frames=60&{SIZE}")
    assert log.moving_mask(29).mean() > 0.01
    assert not log.moving_mask(30).any()
    still = synthetic(f"tabletop?frames=60&{SIZE}")
    np.testing.assert_allclose(log[29].depth, still[29].depth, atol=1e-5)  # until then: the carton of the still scene
    assert np.abs(log[30].depth - still[30].depth).max() > 0.02
    assert log.objects()["carton"].stamps[-1] < 1.0


def test_a_long_log_streams_without_keeping_its_frames() -> None:
    log = synthetic("tabletop?trajectory=laps&frames=2000&width=64&height=48&effects=depth_noise")
    assert len(log) == 2000
    frames = iter(log)
    next(frames)
    tracemalloc.start()
    for _ in range(20):
        next(frames)
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(40):
        next(frames)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 64 * 48 * 7  # not one frame more than at the start
    assert np.diff(log.ground_truth.stamps) == pytest.approx(1 / 30)
