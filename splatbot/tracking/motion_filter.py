"""Pose and velocity of the camera from frame to frame, by a Kalman filter on SE(3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import adjoint, inverse, se3_exp, se3_log, so3_log
from splatbot.tracking.align import Alignment
from splatbot.tracking.gyroscope import MeasuredTurn

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionFilterConstants:
    """Constants of the motion of a camera on a hand or an arm."""

    acceleration: float = 1.0
    """Standard deviation [m/s²] of an acceleration that persists over ``correlation``. A larger value smooths less."""
    angular_acceleration: float = 6.0
    """Standard deviation [rad/s²] of such an angular acceleration."""
    correlation: float = 0.1
    """Time [s] over which an acceleration persists."""
    speed: float = 1.0
    """Standard deviation [m/s] of an unknown velocity, and of an unknown angular velocity in 2 [rad/s]."""
    max_gap: float = 0.15
    """Longest time [s] between two frames over which the acceleration of a hand is nearly constant. Over a longer one
    the velocity is unknown."""


CONSTANTS = MotionFilterConstants()

_DAMPING = 1e-12  # variance [m², rad²] of a pose that is stated to be exact
_BAND_DAMPING = 1e-3  # information [1/m², 1/rad²] of any pose, as in splatbot.tracking.uncertainty


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Pose and velocity of the camera at one time.

    Args:
        stamp: time [s].
        T_world_camera: (4, 4).
        twist: (6,) velocity (translation [m/s], rotation [rad/s]) in the camera's frame.
        covariance: (12, 12) of the errors x = (ξ, η): T_world_camera exp(ξ) is the true pose and twist + η the true
            velocity.
    """

    stamp: float
    T_world_camera: Array
    twist: Array
    covariance: Array

    @classmethod
    def at_pose(
        cls, stamp: float, T_world_camera: Array, covariance: Array, twist: Array | None = None
    ) -> CameraMotion:
        """Return the state at a pose (4, 4) with a covariance (6, 6); the velocity is unknown, or known to a tenth."""
        p, P = CONSTANTS, np.zeros((12, 12))
        sigma = np.repeat([p.speed, 2 * p.speed], 3) * (1.0 if twist is None else 0.1)
        P[:6, :6], P[6:, 6:] = covariance + _DAMPING * np.eye(6), np.diag(sigma**2)
        return cls(stamp, T_world_camera, np.zeros(6) if twist is None else twist, P)

    def predict(self, stamp: float) -> CameraMotion:
        """Return the state at a later time [s] under white noise of acceleration.

        Barfoot, "State estimation for robotics" (2017), section 11.1, with the step dt, the twist ϖ and the spectral
        density S of the acceleration::

            T ← T exp(dt ϖ)
            F = [Ad(exp(-dt ϖ))  dt 1]      Q = [dt³/3 S  dt²/2 S]
                [0                  1]          [dt²/2 S     dt S]
            P ← F P Fᵀ + Q
        """
        dt = stamp - self.stamp
        F = np.eye(12)
        F[:6, :6], F[:6, 6:] = adjoint(se3_exp(-dt * self.twist)), dt * np.eye(6)
        T = self.T_world_camera @ se3_exp(dt * self.twist)
        return CameraMotion(stamp, T, self.twist, F @ self.covariance @ F.T + _process_noise(dt))

    def predict_turn(self, stamp: float, turn: MeasuredTurn) -> CameraMotion:
        """Return the state at a later time [s], whose rotation is that of a gyroscope and not of the velocity.

        The rotation φ and the angular rate ω of the gyroscope are inputs. Their errors (e_φ, e_ω) replace the angular
        rows of F and Q, since the angular velocity so far has no influence::

            T ← T exp((dt v, φ))
            ξ ← Ad(exp(-(dt v, φ))) ξ + (dt η_v + q_ξ, e_φ)
            η ← (η_v + q_η, e_ω)
        """
        dt = stamp - self.stamp
        motion = np.concatenate([dt * self.twist[:3], so3_log(turn.R_last_camera)])
        F, Q = np.zeros((12, 12)), _process_noise(dt)
        F[:6, :6], F[:3, 6:9], F[6:9, 6:9] = adjoint(se3_exp(-motion)), dt * np.eye(3), np.eye(3)
        angular = np.r_[3:6, 9:12]
        Q[np.ix_(angular, angular)] = turn.covariance
        twist = np.concatenate([self.twist[:3], turn.rate])
        return CameraMotion(stamp, self.T_world_camera @ se3_exp(motion), twist, F @ self.covariance @ F.T + Q)

    def measure(self, alignment: Alignment, covariance: Array, used: Array, readout: float) -> CameraMotion:
        """Return the state after the alignment of a frame, which measures the pose and, by its rows, the velocity.

        The residuals of a rectified image depend on the pose and on the error of its twist. Row s, s seconds after the
        stamp, sees a point moved by -(ξ + s η). Bands of rows at times s_b have the normal equations (H_b, g_b), with
        the moments H_n = Σ s_bⁿ H_b and G = H_0⁻¹ H_1::

            information = [Σ⁻¹     Σ⁻¹ G                            ]
                          [Gᵀ Σ⁻¹  Gᵀ Σ⁻¹ G + (H_2 - H_1 G) / k]
            gradient    = [0, (Σ s_b g_b - H_1 H_0⁻¹ Σ g_b) / k]

        The pose of the whole image is that at the mean time of its rows, and has the covariance Σ. The rest of the rows
        measures the velocity. The factor k by which residuals are correlated follows from Σ: k⁶ = det(Σ) det(H_0).
        Rows of depth with a delay count as those of colour. Without rows the information is Σ⁻¹ alone.

        Args:
            alignment: alignment of the rectified image.
            covariance: (6, 6) of its pose Σ, large in directions that the frame does not constrain.
            used: (6,) twist [m/s, rad/s] with which the image was rectified.
            readout: time from the first row to the last [s].
        """
        gradient, g, H = np.zeros(12), alignment.band_gradient, alignment.band_information
        n, H0 = len(g), H.sum(0) + _BAND_DAMPING * np.eye(6)
        covariance = covariance + _DAMPING * np.eye(6)
        pose_information, G, rows = np.linalg.inv(covariance), np.zeros((6, 6)), np.zeros((6, 6))
        if readout > 0 and n > 0 and np.isfinite(H0).all() and np.isfinite(g).all():
            s = ((np.arange(n) + 0.5) / n - 0.5) * readout
            H1, H2 = np.einsum("b,bij->ij", s, H), np.einsum("b,bij->ij", s**2, H)
            log_k = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(H0)[1]
            k = np.exp(max(float(log_k), 0.0) / 6)
            G = np.linalg.solve(H0, H1)
            rows, gradient[6:] = (H2 - H1 @ G) / k, (s @ g - G.T @ g.sum(0)) / k
        coupled = pose_information @ G
        information = np.block([[pose_information, coupled], [coupled.T, G.T @ coupled + rows]])
        moved = se3_log(inverse(self.T_world_camera) @ alignment.T_world_camera)
        at = np.concatenate([moved, used - self.twist])
        P = np.linalg.inv(np.linalg.inv(self.covariance) + information)
        x = P @ (information @ at + gradient)
        return CameraMotion(self.stamp, self.T_world_camera @ se3_exp(x[:6]), self.twist + x[6:], 0.5 * (P + P.T))


class MotionFilter:
    """The motion of the camera by the poses of its frames.

    Differences of noisy poses are no usable velocity: an error of the velocity displaces the rows of the next frame,
    which displaces its pose. The filter weighs each pose and its rows against a motion with bounded acceleration.
    """

    def __init__(self) -> None:
        self._state: CameraMotion | None = None

    def predict(self, stamp: float, turn: MeasuredTurn | None = None) -> CameraMotion | None:
        """Return the state at a time [s]; None at the start and over more than ``CONSTANTS.max_gap``.

        A gyroscope predicts the rotation, unless it is doubted.
        """
        if self._state is None or not 0 < stamp - self._state.stamp <= CONSTANTS.max_gap:
            return None
        if turn is not None and not turn.is_doubted:
            return self._state.predict_turn(stamp, turn)
        return self._state.predict(stamp)

    def twist_at(self, stamp: float) -> Array:
        """Return the expected twist (6,) [m/s, rad/s] at a time [s] near the last pose, zero where it is unknown."""
        if self._state is None or abs(stamp - self._state.stamp) > CONSTANTS.max_gap:
            return np.zeros(6)
        return self._state.twist

    def update(self, state: CameraMotion) -> None:
        """Replace the state."""
        self._state = state

    def move(self, T_new_old: Array) -> None:
        """Move the pose with a correction (4, 4) of the map; the velocity stays."""
        if self._state is not None:
            self._state = replace(self._state, T_world_camera=T_new_old @ self._state.T_world_camera)

    def forget(self) -> None:
        """Discard the motion, after a lost frame."""
        self._state = None


def _process_noise(dt: float) -> Array:
    """Return the covariance (12, 12) that white noise of acceleration adds to pose and velocity in a time [s]."""
    p = CONSTANTS
    density = p.correlation * np.repeat([p.acceleration**2, p.angular_acceleration**2], 3)
    return np.asarray(np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.diag(density)), np.float64)


def mean_twist(T_first_second: Array, seconds: float) -> Array:
    """Return the mean twist (6,) [m/s, rad/s] of a motion (4, 4); zero over more than ``CONSTANTS.max_gap``."""
    return se3_log(T_first_second) / seconds if 0 < seconds <= CONSTANTS.max_gap else np.zeros(6)
