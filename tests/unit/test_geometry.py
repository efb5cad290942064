"""SE(3): group axioms, and exp, log and quaternions against mpmath, scipy and the matrix exponential."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from splatbot.geometry import (
    inverse,
    pose_from_quat,
    quat_to_rotation,
    rotation_to_quat,
    se3_exp,
    se3_log,
    skew,
    so3_exp,
    so3_log,
    transform_points,
)

ANGLES = [1e-12, 1e-9, 1e-7, 1e-5, 0.99e-4, 1.01e-4, 1e-3, 0.1, 1.0, 2.0, 3.0, np.pi - 1e-5, np.pi - 1e-9]


def axes(rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors: the coordinate axes, their opposites and random ones."""
    v = np.vstack([np.eye(3), -np.eye(3), rng.normal(size=(10, 3))])
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def exact_rotation(omega: np.ndarray) -> np.ndarray:
    """Evaluate Rodrigues' formula with 50 digits."""
    with mpmath.workdps(50):
        w = [mpmath.mpf(float(x)) for x in omega]
        theta = mpmath.sqrt(sum(x * x for x in w))
        W = mpmath.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        R = mpmath.eye(3) + W * (mpmath.sin(theta) / theta) + W * W * ((1 - mpmath.cos(theta)) / theta**2)
        return np.array([[float(R[i, j]) for j in range(3)] for i in range(3)])


def test_skew_is_the_cross_product(rng: np.random.Generator) -> None:
    v, w = rng.normal(size=(2, 3))
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_equal_those_of_fifty_digits(angle: float, rng: np.random.Generator) -> None:
    for axis in axes(rng):
        np.testing.assert_allclose(so3_exp(angle * axis), exact_rotation(angle * axis), rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp_from_tiny_angles_to_almost_pi(angle: float, rng: np.random.Generator) -> None:
    for axis in axes(rng):
        omega = angle * axis
        np.testing.assert_allclose(so3_log(so3_exp(omega)), omega, rtol=0, atol=2e-15 + 4e-16 * angle)
        if angle < 1e-6:  # small ones must keep their digits relative to themselves too
            np.testing.assert_allclose(so3_log(so3_exp(omega)), omega, rtol=0, atol=1e-15 * angle)


def test_log_at_exactly_pi_is_one_of_the_two_axes(rng: np.random.Generator) -> None:
    for axis in axes(rng):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        omega = so3_log(R)
        assert np.linalg.norm(omega) == pytest.approx(np.pi, abs=1e-15)
        np.testing.assert_allclose(so3_exp(omega), R, atol=1e-14)


def test_log_of_what_is_no_rotation_answers_without_raising() -> None:
    assert np.isfinite(so3_log(np.zeros((3, 3)))).all()
    assert np.isnan(so3_log(np.full((3, 3), np.nan))).all()


def test_zero_motion_is_the_identity_exactly() -> None:
    assert np.array_equal(so3_exp(np.zeros(3)), np.eye(3))
    assert np.array_equal(se3_exp(np.zeros(6)), np.eye(4))
    assert np.array_equal(se3_log(np.eye(4)), np.zeros(6))


@pytest.mark.parametrize("angle", ANGLES)
def test_pose_exponential_equals_the_matrix_exponential(angle: float, rng: np.random.Generator) -> None:
    for axis in axes(rng):
        xi = np.concatenate([rng.normal(size=3), angle * axis])
        X = np.zeros((4, 4))
        X[:3, :3], X[:3, 3] = skew(xi[3:]), xi[:3]
        # 1 - cos θ has lost most digits where the closed form takes over from the series: ε/θ at θ = 1e-4.
        np.testing.assert_allclose(se3_exp(xi), expm(X), rtol=0, atol=2e-12 if angle < 1e-2 else 2e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_pose_log_inverts_exp(angle: float, rng: np.random.Generator) -> None:
    for axis in axes(rng):
        xi = np.concatenate([rng.normal(size=3), angle * axis])
        np.testing.assert_allclose(se3_log(se3_exp(xi)), xi, rtol=0, atol=2e-14)


def test_rigid_transforms_form_a_group(rng: np.random.Generator) -> None:
    A, B, C = (se3_exp(rng.normal(size=6)) for _ in range(3))
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-14)
    np.testing.assert_allclose(inverse(A) @ A, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(A @ inverse(A), np.eye(4), atol=1e-14)
    np.testing.assert_allclose(inverse(A @ B), inverse(B) @ inverse(A), atol=1e-14)
    np.testing.assert_allclose(A[:3, :3] @ A[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(A[:3, :3]) == pytest.approx(1, abs=1e-14)


def test_points_transform_as_homogeneous_vectors(rng: np.random.Generator) -> None:
    T, points = se3_exp(rng.normal(size=6)), rng.normal(size=(4, 5, 3))
    homogeneous = np.concatenate([points, np.ones((4, 5, 1))], -1)
    np.testing.assert_allclose(transform_points(T, points), (homogeneous @ T.T)[..., :3], atol=1e-14)
    np.testing.assert_allclose(transform_points(inverse(T), transform_points(T, points)), points, atol=1e-14)


def test_quaternions_agree_with_scipy_in_both_directions(rng: np.random.Generator) -> None:
    q = rng.normal(size=(200, 4))
    expected = Rotation.from_quat(q[:, [1, 2, 3, 0]])
    np.testing.assert_allclose(quat_to_rotation(q), expected.as_matrix(), atol=2e-15)
    back = rotation_to_quat(expected.as_matrix())
    np.testing.assert_allclose(back[:, [1, 2, 3, 0]], expected.as_quat(canonical=True), atol=1e-15)
    assert (back[:, 0] >= 0).all()


@pytest.mark.parametrize("quat", [(0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (1e-9, 0.6, -0.8, 0), (1, 0, 0, 0)])
def test_quaternions_of_half_turns_survive(quat: tuple[float, ...]) -> None:
    R = quat_to_rotation(quat)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(quat_to_rotation(rotation_to_quat(R)), R, atol=1e-15)


@pytest.mark.parametrize("norm", [1e-300, 1e-30, 1e30, 1e300])
def test_the_norm_of_a_quaternion_does_not_matter(norm: float) -> None:
    q = np.array([0.5, -0.3, 0.2, 0.7])
    np.testing.assert_allclose(quat_to_rotation(norm * q), quat_to_rotation(q), atol=1e-15)


@pytest.mark.parametrize("quat", [(0, 0, 0, 0), (1, 0, np.nan, 0), (np.inf, 0, 0, 0)])
def test_quaternions_that_are_no_rotation_are_refused(quat: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="zero or not finite"):
        quat_to_rotation(quat)


def test_poses_of_many_quaternions_at_once(rng: np.random.Generator) -> None:
    t, q = rng.normal(size=(6, 3)), rng.normal(size=(6, 4))
    T = pose_from_quat(t, q)
    assert T.shape == (6, 4, 4)
    for i in range(6):
        assert np.array_equal(T[i, :3, :3], quat_to_rotation(q[i]))
        assert np.array_equal(T[i, :3, 3], t[i])
        assert T[i, 3].tolist() == [0, 0, 0, 1]
