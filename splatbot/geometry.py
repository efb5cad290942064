"""SE(3), rotations and quaternions in float64. Quaternions are wxyz; T_a_b maps points of frame b to frame a."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Below this angle [rad] the closed forms lose digits in (1 - cos θ)/θ²; their Taylor series do not.
_SMALL_ANGLE = 1e-4


def skew(v: ArrayLike) -> Array:
    """Return the cross-product matrix (3, 3) of a vector (3,): ``skew(v) @ w == cross(v, w)``."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(omega: ArrayLike) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) [rad] by Rodrigues' formula."""
    w = np.asarray(omega, dtype=np.float64)
    theta = float(np.linalg.norm(w))
    W = skew(w)
    if theta < _SMALL_ANGLE:
        return np.eye(3) + W * (1.0 - theta**2 / 6.0) + W @ W * (0.5 - theta**2 / 24.0)
    return np.eye(3) + W * (np.sin(theta) / theta) + W @ W * ((1.0 - np.cos(theta)) / theta**2)


def so3_log(R: ArrayLike) -> Array:
    """Return the rotation vector (3,) [rad] of a rotation matrix (3, 3), with a norm in [0, π].

    Up to a right angle the skew part, of length sin θ, gives the vector. Beyond, the quaternion gives it, which is
    accurate near π.
    """
    M = np.asarray(R, dtype=np.float64)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = M.tolist()
    times, cosine, v = 1.0, 0.5 * (xx + yy + zz - 1.0), 0.5 * np.array([zy - yz, xz - zx, yx - xy])
    if not cosine > 0.0:  # of half the angle; NaN too
        times, (cosine, *xyz) = 2.0, rotation_to_quat(M)
        v = np.array(xyz)
    sine = math.hypot(*v.tolist())
    return times * v * (math.atan2(sine, cosine) / sine if sine > _SMALL_ANGLE else 1.0 + sine**2 / 6.0)


def rotation_angles(R: Array) -> Array:
    """Return the angles (N,) [rad] in [0, π] of rotation matrices (N, 3, 3)."""
    sine = np.linalg.norm(R - R.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(8)
    return np.asarray(np.arctan2(sine, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1)))


def nearest_rotation(M: ArrayLike) -> Array:
    """Return the rotation (3, 3) nearest to a matrix (3, 3) in the Frobenius norm (Umeyama 1991)."""
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)


def se3_exp(xi: ArrayLike) -> Array:
    """Return the pose (4, 4) of a twist (6,) = (translation [m], rotation [rad]) (Barfoot 2017, eq. 7.85)."""
    x = np.asarray(xi, dtype=np.float64)
    T = np.eye(4)
    T[:3, :3] = so3_exp(x[3:])
    T[:3, 3] = _left_jacobian(x[3:]) @ x[:3]
    return T


def se3_log(T: ArrayLike) -> Array:
    """Return the twist (6,) = (translation [m], rotation [rad]) of a pose (4, 4); inverse of :func:`se3_exp`."""
    M = np.asarray(T, dtype=np.float64)
    omega = so3_log(M[:3, :3])
    return np.concatenate([np.linalg.solve(_left_jacobian(omega), M[:3, 3]), omega])


def _left_jacobian(omega: Array) -> Array:
    theta = float(np.linalg.norm(omega))
    W = skew(omega)
    if theta < _SMALL_ANGLE:
        return np.eye(3) + W * (0.5 - theta**2 / 24.0) + W @ W * (1.0 / 6.0 - theta**2 / 120.0)
    a = (1.0 - np.cos(theta)) / theta**2
    b = (theta - np.sin(theta)) / theta**3
    return np.eye(3) + a * W + b * W @ W


def inverse(T: ArrayLike) -> Array:
    """Return the inverse (4, 4) of a rigid transform (4, 4)."""
    M = np.asarray(T, dtype=np.float64)
    out = np.eye(4)
    out[:3, :3] = M[:3, :3].T
    out[:3, 3] = -M[:3, :3].T @ M[:3, 3]
    return out


def adjoint(T_a_b: ArrayLike) -> Array:
    """Return the matrix Ad (6, 6) that maps a twist of frame b to frame a: T exp(ξ) T⁻¹ = exp(Ad ξ)."""
    M = np.asarray(T_a_b, dtype=np.float64)
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = M[:3, :3]
    A[:3, 3:] = skew(M[:3, 3]) @ M[:3, :3]
    return A


def transform_points(T_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Transform points (..., 3) [m] of frame b to frame a."""
    M = np.asarray(T_a_b, dtype=np.float64)
    return np.asarray(points_b, dtype=np.float64) @ M[:3, :3].T + M[:3, 3]


def look_at(eye: Array, target: Array, *, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Return T_world_camera (4, 4) of an upright camera at ``eye`` (3,), facing ``target`` (3,) [m].

    Args:
        eye, target: two points whose line is not along ``up``.
        up: (3,) direction that is up in the image.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = eye
    return T


def quat_to_rotation(quat: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) wxyz of any positive norm.

    Raises:
        ValueError: a quaternion is zero or not finite.
    """
    q = np.asarray(quat, dtype=np.float64)
    scale = np.max(np.abs(q), axis=-1, keepdims=True)
    if not np.all(np.isfinite(scale)) or np.any(scale == 0.0):
        raise ValueError("a quaternion is zero or not finite")
    q = q / scale  # first by the largest entry: 1e-200 and 1e200 must not under- or overflow when squared
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def rotation_to_quat(R: ArrayLike) -> Array:
    """Return the quaternions (..., 4) wxyz, w >= 0, of rotation matrices (..., 3, 3) (Shepperd 1978, largest pivot)."""
    M = np.asarray(R, dtype=np.float64)
    xx, yy, zz = M[..., 0, 0], M[..., 1, 1], M[..., 2, 2]
    sums = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)  # 4 q_i²
    a, b, c = M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]
    d, e, f = M[..., 1, 0] + M[..., 0, 1], M[..., 0, 2] + M[..., 2, 0], M[..., 2, 1] + M[..., 1, 2]
    rows = np.stack(  # 4 q_i q_j
        [
            np.stack([sums[..., 0], a, b, c], -1),
            np.stack([a, sums[..., 1], d, e], -1),
            np.stack([b, d, sums[..., 2], f], -1),
            np.stack([c, e, f, sums[..., 3]], -1),
        ],
        -2,
    )
    pivot = np.argmax(sums, axis=-1)
    q = np.take_along_axis(rows, pivot[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def frame_along(z: ArrayLike) -> Array:
    """Return a rotation (3, 3) whose third column is the unit vector z (3,)."""
    axis = np.asarray(z, dtype=np.float64)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(axis)))], axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def quat_multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the Hamilton products (..., 4) wxyz: the rotation ``b``, then ``a``."""
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    w = pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)
    return np.concatenate([w, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def pose_from_quat(translation: ArrayLike, quat: ArrayLike) -> Array:
    """Return the poses (..., 4, 4) of translations (..., 3) [m] and quaternions (..., 4) wxyz."""
    t = np.asarray(translation, dtype=np.float64)
    T = np.zeros((*t.shape[:-1], 4, 4))
    T[..., :3, :3] = quat_to_rotation(quat)
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T
