"""The synthetic log: depth and poses are exact, colours belong to places."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.geometry import inverse, transform_points
from splatbot.logs import open_log
from splatbot.logs.scenes import RaycastScene, RaycastSurface
from splatbot.logs.shapes import TriangleMesh, box, cup, cylinder, handle, sphere
from splatbot.logs.textures import Texture, value_noise

SMALL = "synthetic:tabletop?width=160&height=120"


def test_options_set_length_size_and_rate() -> None:
    log = open_log(f"{SMALL}&frames=7&rate=10")
    assert (len(log), log.name) == (7, "tabletop")
    assert log[0].rgb.shape == (120, 160, 3)
    assert [frame.stamp for frame in log] == pytest.approx([i / 10 for i in range(7)])
    assert (open_log("synthetic:tabletop").camera.width, open_log("synthetic:tabletop").camera.height) == (640, 480)


def test_a_frame_is_the_same_each_time_and_sees_depth_everywhere() -> None:
    a, b = open_log(SMALL), open_log(SMALL)
    _ = a[3]
    assert np.array_equal(a[5].rgb, b[5].rgb)
    assert np.array_equal(a[5].depth, b[5].depth)
    assert a[5].valid.all()


def test_the_table_top_is_at_z_zero_in_the_true_world() -> None:
    log = open_log(SMALL)
    truth = log.ground_truth
    assert truth is not None
    for i in (0, 40, 119):
        points = transform_points(truth.T_world_camera[i], log.camera.backproject(log[i].depth)).reshape(-1, 3)
        above = points[(np.abs(points[:, :2]) < [0.59, 0.39]).all(axis=1) & (points[:, 2] > -0.5), 2]  # not the floor
        assert np.mean(np.abs(above) < 2e-6) > 0.7  # the rest are the objects on the table
        assert above.min() > -2e-6
        assert 0.1 < above.max() < 0.15


def test_depth_of_one_frame_predicts_another_through_the_true_poses() -> None:
    log = open_log(SMALL)
    truth = log.ground_truth
    assert truth is not None
    first, second = log[0], log[12]
    T_second_first = inverse(truth.T_world_camera[12]) @ truth.T_world_camera[0]
    points = transform_points(T_second_first, log.camera.backproject(first.depth)).reshape(-1, 3)
    u, v = np.rint(log.camera.project(points)).astype(int).T
    inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
    difference = np.abs(second.depth[v[inside], u[inside]] - points[inside, 2])
    assert inside.mean() > 0.7
    assert np.median(difference) < 0.002  # half a pixel's worth of depth on slanted surfaces
    assert np.mean(difference < 0.01) > 0.85
    colors = np.abs(second.rgb[v[inside], u[inside]].astype(int) - first.rgb.reshape(-1, 3)[inside])
    assert np.median(colors) < 10


def test_motion_is_smooth_and_spans_the_arc() -> None:
    truth = open_log("synthetic:tabletop?frames=240&arc=40").ground_truth
    assert truth is not None
    p = truth.positions
    azimuth = np.degrees(np.arctan2(p[:, 1], p[:, 0]))
    assert azimuth.max() - azimuth.min() == pytest.approx(40, abs=0.1)
    assert np.linalg.norm(np.diff(p, axis=0), axis=1).max() < 0.012
    assert np.linalg.norm(np.diff(p, 2, axis=0), axis=1).max() < 5e-4
    R = truth.T_world_camera[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (240, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-14)
    assert (R[:, 2, 1] < 0).all()  # image rows run downwards in the world


@pytest.mark.parametrize(
    ("uri", "field"),
    [
        ("synthetic:kitchen", "scene"),
        ("synthetic:tabletop?frame=3", "frame"),
        ("synthetic:tabletop?frames=0", "frames"),
        ("synthetic:tabletop?frames=many", "frames"),
        ("synthetic:tabletop?width=", "width"),
        ("synthetic:tabletop?arc=nan", "arc"),
        ("synthetic:tabletop?seed=-1", "seed"),
        ("synthetic:tabletop?trajectory=spiral", "trajectory"),
        ("synthetic:tabletop?effects=exposre", "effect"),
        ("synthetic:tabletop?effects=exposure:step=-1", "effect exposure: step"),
        ("synthetic:tabletop?frames=1&effects=frame_drops:rate=0.999999", "effects"),
    ],
)
def test_a_wrong_uri_is_named(uri: str, field: str) -> None:
    with pytest.raises(LogError) as caught:
        open_log(uri)
    assert (caught.value.file, caught.value.field) == (uri, field)
    assert caught.value.hint


def test_a_synthetic_log_takes_no_other_camera() -> None:
    with pytest.raises(LogError, match="its own camera"):
        open_log(SMALL, camera="tum_fr1")


def volume(mesh: TriangleMesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return abs(float(np.sum(a * np.cross(b, c)) / 6))


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (box([0.2, 0.3, 0.4]), 0.024),
        (cylinder(0.1, 0.5), np.pi * 0.01 * 0.5),
        (sphere(0.1), 4 / 3 * np.pi * 0.001),
        (cup(0.05, 0.1, 0.01), np.pi * (0.05**2 * 0.1 - 0.04**2 * 0.09)),
        (handle(0.03, 0.005), np.pi * 0.03 * np.pi * 0.005**2),
    ],
)
def test_shapes_are_closed_and_have_their_volume(mesh: TriangleMesh, expected: float) -> None:
    assert volume(mesh) == pytest.approx(expected, rel=0.02)


def test_a_ray_cast_sphere_has_the_depth_of_the_closed_form() -> None:
    log = open_log(SMALL)
    scene = RaycastScene([RaycastSurface(sphere(0.3).placed([0, 0, -0.3]), Texture((1, 1, 1), (0, 0, 0)))])
    T = np.eye(4)
    T[:3, 3] = [0, 0, -2.0]
    rgb, depth = scene.render(log.camera, T)
    d = log.camera.backproject(np.ones((120, 160), np.float32)).astype(np.float64)
    a, b, c = (d * d).sum(-1), -2 * d @ [0, 0, 2.0], 4.0 - 0.09
    disc = b * b - 4 * a * c
    hit = disc > 0.05  # not at the silhouette, where facets differ from the sphere
    exact = (-b - np.sqrt(np.where(hit, disc, 0))) / (2 * a)
    assert hit.sum() > 1000
    np.testing.assert_allclose(depth[hit], exact[hit], atol=1.5e-3)
    assert (depth[disc < -0.05] == 0).all()
    assert (rgb[disc < -0.05] == 0).all()


def test_noise_is_continuous_and_fills_zero_to_one(rng: np.random.Generator) -> None:
    points = rng.uniform(-50, 50, (5000, 3))
    values = value_noise(points)
    assert 0 <= values.min() < 0.2
    assert 0.8 < values.max() <= 1
    assert np.abs(value_noise(points + 1e-6) - values).max() < 1e-5
    cells = np.floor(points)
    assert np.abs(value_noise(cells) - value_noise(cells - 1e-9)).max() < 1e-6
