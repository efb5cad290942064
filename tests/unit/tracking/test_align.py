"""Alignment: equations against finite differences, poses recovered to a bound, no step without information."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import TrackingConfig
from splatbot.geometry import inverse, se3_exp, se3_log, transform_points
from splatbot.logs.synthetic import SyntheticLog
from splatbot.tracking.align import align, residuals
from splatbot.tracking.features import FeaturePose
from splatbot.tracking.prepare import Level, prepare
from splatbot.tracking.reference import Reference, ReferencePoints, make_reference
from splatbot.tracking.tracker import pose_distance
from tests.rgbd import CAMERA, Array, rays_of, small_config, tabletop, wall_depth, wall_frame

CONFIG = small_config().tracking
SIGMA_GRAY, FLOOR, QUAD, GATE, NU = 0.02, 1e-3, 2e-3, 0.05, 4.0
STEP = 1e-6


@dataclass
class Problem:
    """Reference points against one image whose interpolation has a closed form; everything float32-exact."""

    gray: Callable[[Array, Array], Array]  # of pixel (u, v); bilinear in them, so that interpolation is exact
    depth: Array
    points: Array
    normals: Array
    reference_gray: Array
    T: Array
    gain: float = 1.1
    offset: float = -0.03

    def native(self, photometric: bool, geometric: bool) -> tuple[Array, Array, float, int, Array, Array]:
        """Return the result of the native kernel."""
        u, v = np.meshgrid(np.arange(float(CAMERA.width)), np.arange(float(CAMERA.height)))
        return _native.linearize_alignment(
            self.gray(u, v).astype(np.float32),
            self.depth.astype(np.float32),
            (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy),
            self.points.astype(np.float32),
            self.normals.astype(np.float32),
            self.reference_gray.astype(np.float32),
            self.T,
            self.gain,
            self.offset,
            _native.AlignSettings(photometric, geometric, SIGMA_GRAY, FLOOR, QUAD, GATE),
        )

    def photometric(self, state: Array) -> Array:
        """Compute the residuals (N,) of grey at a state: twist (6,) on the left of T, gain, offset."""
        q = transform_points(se3_exp(state[:6]) @ self.T, self.points)
        u, v = np.moveaxis(CAMERA.project(q), -1, 0)
        return self.gray(u, v) - (state[6] * self.reference_gray + state[7])

    def geometric(self, state: Array, observed: Array, normals: Array) -> Array:
        """Compute the distances (N,) of the moved points from the planes through the observed points of their rays."""
        q = transform_points(se3_exp(state[:6]) @ self.T, self.points)
        return np.asarray((normals * (observed - q)).sum(1))


def jacobian(residuals: Callable[[Array], Array], state: Array) -> Array:
    """Compute the Jacobian (N, len(state)) by central differences."""
    steps = STEP * np.eye(len(state))
    return np.stack([(residuals(state + s) - residuals(state - s)) / (2 * STEP) for s in steps], axis=1)


def normal_equations(J: Array, r: Array, sigma: Array) -> tuple[Array, Array]:
    """Compute H and g of residuals with the weights of Student's t."""
    w = (NU + 1) / (NU + (r / sigma) ** 2) / sigma**2
    return (J * w[:, None]).T @ J, J.T @ (w * r)


def damped(H: Array) -> Array:
    """Add the damping of a step to H."""
    return np.asarray(H + 1e-5 * np.trace(H) / 6 * np.eye(6), dtype=np.float64)


def assert_close(got: Array, want: Array, tolerance: float = 1e-5) -> None:
    """Compare each entry relative to its Cauchy-Schwarz bound."""
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want))) if want.ndim == 2 else np.abs(want).max()
    assert np.abs((got - want) / np.maximum(scale, 1e-12)).max() < tolerance


@pytest.fixture
def problem(rng: np.random.Generator) -> Problem:
    """200 points near a wall at 1 m, displaced by 1 cm and 1°, in front of an image that is bilinear in its pixels."""
    n = 200
    pixels = rng.uniform([15, 15], [145, 105], (n, 2))
    rays = np.stack([(pixels[:, 0] - CAMERA.cx) / CAMERA.fx, (pixels[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(n)], 1)
    normals = rng.normal(size=(n, 3)) * [0.4, 0.4, 0.1] - [0, 0, 1]
    return Problem(
        gray=lambda u, v: 0.3 + 0.002 * u - 0.001 * v + 1e-5 * u * v,
        depth=np.full((120, 160), 1.0),
        points=(rays * rng.uniform(0.98, 1.02, (n, 1))).astype(np.float32).astype(np.float64),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32).astype(np.float64),
        reference_gray=rng.uniform(0.2, 0.8, n).astype(np.float32).astype(np.float64),
        T=se3_exp([0.01, -0.005, 0.003, 0.01, -0.015, 0.02]),
    )


def test_photometric_equations_equal_finite_differences_exposure_included(problem: Problem) -> None:
    state = np.array([0, 0, 0, 0, 0, 0, problem.gain, problem.offset])
    r = problem.photometric(state)
    J = jacobian(problem.photometric, state)
    H, g = normal_equations(J, r, np.full(len(r), SIGMA_GRAY))
    got_H, got_g, _, projected, r_photo, r_geo = problem.native(True, False)
    assert projected == len(r)
    np.testing.assert_allclose(r_photo, r / SIGMA_GRAY, atol=1e-4)
    assert np.isnan(r_geo).all()
    assert_close(got_H, H)
    assert_close(got_g, g)


def test_geometric_equations_equal_finite_differences_of_point_to_plane_distances(problem: Problem) -> None:
    q = transform_points(problem.T, problem.points)
    observed = q / q[:, 2:]  # the wall is at 1 m
    normals = problem.normals @ problem.T[:3, :3].T
    state = np.zeros(6)
    r = problem.geometric(state, observed, normals)
    J = jacobian(lambda s: problem.geometric(s, observed, normals), state)
    sigma = FLOOR + (FLOOR + QUAD * q[:, 2] ** 2) * np.abs((normals * q).sum(1)) / np.linalg.norm(q, axis=1)
    H, g = normal_equations(J, r, sigma)
    got_H, got_g, _, _, r_photo, r_geo = problem.native(False, True)
    np.testing.assert_allclose(r_geo, r / sigma, atol=1e-3)
    assert np.isnan(r_photo).all()
    assert_close(got_H[:6, :6], H)
    assert_close(got_g[:6], g)
    assert not got_H[6:].any()
    assert not got_g[6:].any()


def test_on_the_surface_the_geometric_jacobian_is_that_of_the_whole_residual() -> None:
    """There, the observed point slides along the plane when the reference point moves: association costs nothing."""
    normal = np.array([0.2, -0.3, 0.93]) / np.linalg.norm([0.2, -0.3, 0.93])
    depth = wall_depth(CAMERA, np.eye(4), normal, 1.0)
    rows, columns = np.meshgrid(np.arange(20, 100, 5), np.arange(20, 140, 5), indexing="ij")
    points = (rays_of(CAMERA) * depth[..., None])[rows.ravel(), columns.ravel()]
    normals = np.broadcast_to(-normal, points.shape).copy()

    def whole(twist: Array) -> Array:
        M = se3_exp(twist)
        q, n = transform_points(M, points), normals @ M[:3, :3].T
        observed = q / (q @ normal)[:, None]  # where the ray through q meets the plane
        return np.asarray((n * (observed - q)).sum(1))

    J = jacobian(whole, np.zeros(6))
    sigma_z = FLOOR + QUAD * points[:, 2] ** 2
    sigma = FLOOR + sigma_z * np.abs(points @ normal) / np.linalg.norm(points, axis=1)
    H, _ = normal_equations(J, np.zeros(len(points)), sigma)
    problem = Problem(lambda u, v: 0 * u + 0.5, depth, points, normals, np.full(len(points), 0.5), np.eye(4))
    got, g, _, _, _, residuals = problem.native(False, True)
    assert np.abs(residuals).max() < 0.02  # depth is interpolated linearly between pixels: 1e-5 m here
    assert_close(got[:6, :6], H, 1e-3)
    assert np.abs(g[:6]).max() < 1e-3 * np.sqrt(np.diag(H).max())  # σ of the strongest state: no pull


def test_cost_is_that_of_the_student_t_distribution(problem: Problem) -> None:
    _, _, cost, _, r_photo, r_geo = problem.native(True, True)
    s = np.concatenate([r_photo, r_geo]).astype(np.float64)
    assert cost == pytest.approx(0.5 * (NU + 1) * np.log1p(s**2 / NU).sum(), rel=1e-6)


def test_points_behind_outside_occluded_or_without_a_surface_have_no_residual(problem: Problem) -> None:
    problem.T = np.eye(4)
    problem.points[0] = [0.0, 0.0, -1.0]  # behind the camera
    problem.points[1] = [5.0, 0.0, 1.0]  # outside the image
    problem.points[2] = [0.4, 0.2, 2.0]  # 1 m behind the wall
    problem.points[3] = [0.1, 0.1, 0.0]  # in the camera's plane
    problem.points[4] = np.nan
    problem.points[5] = [0.0, 0.0, 1.0]
    u, v = np.rint(CAMERA.project(problem.points[5])).astype(int)
    problem.depth[v - 1 : v + 2, u - 1 : u + 2] = 0.0  # nothing measured: grey alone
    H, g, _, _, r_photo, r_geo = problem.native(True, True)
    assert np.isnan(r_photo[:5]).all()
    assert np.isnan(r_geo[:6]).all()
    assert np.isfinite(r_photo[5:]).all()
    assert np.isfinite(H).all()
    assert np.isfinite(g).all()


def test_feature_equations_equal_finite_differences_of_reprojection(rng: np.random.Generator) -> None:
    points = rng.uniform([-0.4, -0.3, 0.7], [0.4, 0.3, 2.0], (60, 3))
    T_camera_world = se3_exp([0.02, 0.01, -0.03, 0.05, -0.02, 0.04])
    pixels = CAMERA.project(transform_points(T_camera_world, points)) + rng.normal(0, 2.0, (60, 2))
    sigmas = rng.uniform(1.0, 3.5, 61)
    behind = np.vstack([points, [[0, 0, -1.0]]])
    features = FeaturePose(np.eye(4), behind, np.vstack([pixels, [[80, 60]]]), sigmas, 61)
    blank = np.zeros((120, 160), np.float32)
    found = align(
        [Level(blank, blank, CAMERA)],
        [],
        inverse(T_camera_world),
        CONFIG.model_copy(update={"iterations": 1, "dense_share": 0.0}),
        photometric=True,
        finest=0,
        gate=GATE,
        features=features,
        camera=CAMERA,
    )

    def reprojection(twist: Array) -> Array:
        q = transform_points(se3_exp(twist) @ T_camera_world, points)
        return np.asarray(((CAMERA.project(q) - pixels) / sigmas[:60, None]).ravel())

    J, r = jacobian(reprojection, np.zeros(6)), reprojection(np.zeros(6))
    w = np.repeat((NU + 1) / (NU + (r.reshape(-1, 2) ** 2).sum(1)), 2)
    H = (J * w[:, None]).T @ J
    assert_close(found.information, H)
    step = se3_log(inverse(found.T_world_camera) @ inverse(T_camera_world))
    np.testing.assert_allclose(step, -np.linalg.solve(damped(H), J.T @ (w * r)), rtol=1e-6, atol=1e-10)


def test_marginalising_exposure_gives_the_step_of_the_whole_system(problem: Problem) -> None:
    level = Level(np.zeros((120, 160), np.float32), problem.depth.astype(np.float32), CAMERA)
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    level = replace(level, gray=problem.gray(u, v).astype(np.float32))
    gray = problem.reference_gray.astype(np.float32)
    sampled = ReferencePoints(
        problem.points.astype(np.float32), problem.normals.astype(np.float32), gray, np.ones_like(gray)
    )
    problem.gain, problem.offset = 1.0, 0.0  # where alignment starts
    H, g, *_ = problem.native(True, True)
    whole = H.copy()
    whole[6:, 6:] += 100 * np.eye(2)  # the weak anchor of exposure; its gradient vanishes at gain 1, offset 0
    marginal = whole[:6, :6] - whole[:6, 6:] @ np.linalg.solve(whole[6:, 6:], whole[6:, :6])
    gradient = g[:6] - whole[:6, 6:] @ np.linalg.solve(whole[6:, 6:], g[6:])
    sensor = CONFIG.sensor.model_copy(update={"depth_sigma_scale": 1.0})
    plain = {"iterations": 1, "dense_weight": 1.0, "n_pixels": 4800, "dense_share": 0.0, "sensor": sensor}
    config = CONFIG.model_copy(update=plain)
    reference = Reference(np.eye(4), (sampled,))
    found = align([level], [reference], inverse(problem.T), config, photometric=True, finest=0, gate=GATE)
    np.testing.assert_allclose(found.information, marginal, rtol=1e-6, atol=1e-6 * np.abs(marginal).max())
    step = se3_log(inverse(found.T_world_camera) @ inverse(problem.T))
    np.testing.assert_allclose(step, -np.linalg.solve(damped(marginal), gradient), rtol=1e-6, atol=1e-10)


OFFSETS = {
    "translation": [0.010, -0.006, 0.008, 0, 0, 0],
    "rotation": [0, 0, 0, 0.008, -0.010, 0.012],
    "both": [-0.008, 0.005, -0.006, 0.01, 0.006, -0.008],
}


def aligned(frame: Level | tuple[Level, ...], reference: Reference, T: Array, photometric: bool = True) -> Array:
    """Return the pose after the coarse and the fine pass of the tracker."""
    levels = frame if isinstance(frame, tuple) else (frame,)
    for _ in range(2):
        T = align(levels, [reference], T, CONFIG, photometric=photometric, finest=0, gate=GATE).T_world_camera
    return T


@pytest.mark.parametrize("name", OFFSETS)
def test_a_known_offset_on_a_textured_wall_is_recovered(name: str) -> None:
    """The wall leaves three directions to colour alone."""
    normal = np.array([0.1, -0.2, 0.97])
    normal /= np.linalg.norm(normal)
    reference = make_reference(prepare(wall_frame(np.eye(4), normal=normal), CONFIG).levels, np.eye(4), 1200)
    truth = se3_exp(OFFSETS[name])
    levels = prepare(wall_frame(truth, normal=normal), CONFIG).levels
    moved, turned = pose_distance(truth, aligned(levels, reference, np.eye(4)))
    assert moved < 3e-4
    assert turned < 3e-4


@pytest.mark.parametrize("photometric", [False, True])
def test_a_known_offset_on_the_tabletop_is_recovered(photometric: bool) -> None:
    frames, poses = tabletop()
    reference = make_reference(prepare(frames[0], CONFIG).levels, poses[0], 1200)
    levels = prepare(frames[1], CONFIG).levels
    start = poses[1] @ se3_exp(OFFSETS["both"])
    moved, turned = pose_distance(poses[1], aligned(levels, reference, start, photometric))
    assert moved < (1.5e-3 if photometric else 6e-3)
    assert turned < (1.5e-3 if photometric else 6e-3)


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 0.0), (1.0, 0.15), (0.7, 0.2)])
def test_a_change_of_exposure_moves_the_pose_by_less_than_a_millimetre(gain: float, offset: float) -> None:
    reference = make_reference(prepare(wall_frame(np.eye(4)), CONFIG).levels, np.eye(4), 1200)
    truth = se3_exp(OFFSETS["both"])
    frame = wall_frame(truth)
    darker = replace(frame, rgb=np.rint(np.clip(gain * frame.rgb + 255 * offset, 0, 255)).astype(np.uint8))
    moved, turned = pose_distance(truth, aligned(prepare(darker, CONFIG).levels, reference, np.eye(4)))
    assert moved < 1e-3
    assert turned < 1e-3


def test_occluding_edges_do_not_pull_the_pose_along_with_the_parallax() -> None:
    log = SyntheticLog("synthetic:room?trajectory=loop&frames=60&rate=8")  # 6° and 9 cm to the side from frame to frame
    config = TrackingConfig(budget_ms=1000)
    truth, errors = log.ground_truth.T_world_camera, []
    for k in (0, 14, 29, 40):
        before, after = prepare(log[k], config), prepare(log[k + 1], config)
        reference = make_reference(before.levels, truth[k], config.n_pixels)
        T = align(
            after.levels,
            [reference],
            truth[k + 1],
            config,
            photometric=True,
            finest=0,
            gate=GATE,
        ).T_world_camera
        errors.append(se3_log(inverse(truth[k + 1]) @ T)[:3])
    assert np.linalg.norm(errors, axis=1).max() < 0.25e-3  # up to 0.6 mm with the grey of edges


def test_an_offset_between_keyframe_and_world_is_carried_through() -> None:
    T_world_reference = se3_exp([1.0, -2.0, 0.5, 0.3, -1.0, 2.0])
    reference = make_reference(prepare(wall_frame(np.eye(4)), CONFIG).levels, T_world_reference, 1200)
    truth = se3_exp(OFFSETS["both"])
    found = aligned(prepare(wall_frame(truth), CONFIG).levels, reference, T_world_reference)
    moved, turned = pose_distance(T_world_reference @ truth, found)
    assert moved < 2e-4
    assert turned < 2e-4


@pytest.mark.parametrize("lacks", ["depth", "everything"])
@pytest.mark.parametrize("start", [np.zeros(6), [0.3, 0.2, 0.1, 0.2, -0.1, 0.3]])
def test_an_image_without_information_leaves_the_pose_as_it_was(lacks: str, start: list[float]) -> None:
    reference = make_reference(prepare(wall_frame(np.eye(4)), CONFIG).levels, np.eye(4), 1200)
    frame = wall_frame(np.eye(4), textured=lacks != "everything")
    nothing = prepare(replace(frame, depth=np.zeros_like(frame.depth)), CONFIG).levels
    T = se3_exp(start)
    found = align(nothing, [reference], T, CONFIG, photometric=lacks != "depth", finest=0, gate=GATE)
    np.testing.assert_allclose(found.T_world_camera, T, atol=1e-12)
    assert np.isfinite(found.information).all()


def test_no_references_and_empty_references_leave_the_pose_as_it_was() -> None:
    levels = prepare(wall_frame(np.eye(4)), CONFIG).levels
    blind = tuple(Level(level.gray, np.zeros_like(level.depth), level.camera) for level in levels)
    for references in ([], [make_reference(blind, np.eye(4), 400)]):
        T = se3_exp(OFFSETS["both"])
        found = align(levels, references, T, CONFIG, photometric=True, finest=0, gate=GATE)
        np.testing.assert_allclose(found.T_world_camera, T, atol=1e-12)
        assert not found.information.any()


def test_a_bare_wall_leaves_its_own_plane_unknown_and_does_not_move_in_it() -> None:
    reference = make_reference(prepare(wall_frame(np.eye(4), textured=False), CONFIG).levels, np.eye(4), 1200)
    truth = se3_exp([0, 0, 0.01, 0, 0, 0])
    levels = prepare(wall_frame(truth, textured=False), CONFIG).levels
    found = align(levels, [reference], np.eye(4), CONFIG, photometric=True, finest=0, gate=GATE)
    assert found.T_world_camera[2, 3] == pytest.approx(0.01, abs=1e-4)
    assert np.abs(found.T_world_camera[:2, 3]).max() < 1e-4
    eigenvalues = np.linalg.eigvalsh(found.information[:3, :3])
    assert eigenvalues[1] < 1e-6 * eigenvalues[2]


def test_the_same_call_gives_the_same_bits() -> None:
    frames, poses = tabletop()
    reference = make_reference(prepare(frames[0], CONFIG).levels, poses[0], 1200)
    levels = prepare(frames[2], CONFIG).levels
    assert np.array_equal(aligned(levels, reference, poses[0]), aligned(levels, reference, poses[0]))


def test_residuals_are_those_of_the_exposure_that_fits_best() -> None:
    frames, poses = tabletop()
    prepared = prepare(frames[0], CONFIG)
    points = make_reference(prepared.levels, poses[0], 1200).levels[1]
    level = prepared.levels[1]
    darker = Level((0.8 * level.gray + 0.05).astype(np.float32), level.depth, level.camera)
    found = residuals(darker, points, np.eye(4), CONFIG)
    assert (found.gain, found.offset) == pytest.approx((0.8, 0.05), abs=2e-3)
    assert np.nanmedian(np.abs(found.photometric)) < 0.05
    assert np.nanmedian(np.abs(residuals(level, points, np.eye(4), CONFIG).geometric)) < 0.05


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (4, 4)])
def test_images_too_small_to_interpolate_have_no_residuals(size: tuple[int, int]) -> None:
    width, height = size
    tiny = Camera(10.0, 10.0, 0.0, 0.0, width, height)
    image = np.ones((height, width), np.float32)
    points = np.array([[0.0, 0.0, 1.0], [0.1, 0.1, 1.0]], np.float32)
    normals = np.tile(np.array([[0, 0, -1]], np.float32), (2, 1))
    sampled = ReferencePoints(points, normals, np.ones(2, np.float32), np.ones(2, np.float32))
    found = residuals(Level(image, image, tiny), sampled, np.eye(4), CONFIG)
    assert np.isnan(found.photometric[0])
    assert np.isfinite(found.photometric[1]) == (size == (4, 4))  # lands on pixel (1, 1)
