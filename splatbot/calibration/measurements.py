"""Measured poses of a moving frame in a static one: views of a board, or tracked poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatbot.calibration.board import BoardView
from splatbot.camera import Camera
from splatbot.geometry import inverse, so3_exp, so3_log

Array = NDArray[np.float64]


class Measurement(Protocol):
    """Measured poses, one for each view."""

    @property
    def start(self) -> Array:
        """Poses (V, 4, 4) of the moving frame in the static one, for the closed form."""
        ...

    def residuals(self, T_static_moving: Array) -> list[Array]:
        """Compute the errors of each view for predicted poses (V, 4, 4)."""
        ...

    def select(self, rows: NDArray[np.intp]) -> Measurement:
        """Return the measurement at the views ``rows``."""
        ...

    def scaled(self, residuals: list[Array]) -> Measurement:
        """Return the measurement with the standard deviations that the errors show."""
        ...

    def error(self, residuals: list[Array]) -> float:
        """Compute the median error in the unit of :attr:`unit` from residuals."""
        ...

    @property
    def unit(self) -> str:
        """Unit of :meth:`error`."""
        ...

    @property
    def largest_error(self) -> float:
        """Largest :meth:`error` of a useful calibration; beyond it, an input is wrong."""
        ...


@dataclass(frozen=True, eq=False)
class BoardMeasurement:
    """Views of a board by one camera.

    Args:
        views: corners of the views.
        camera: camera with its distortion.
        eye_in_hand: whether the camera moves; else the board does.
        sigma: median magnitude of a coordinate's error, at least 1 px.
    """

    views: tuple[BoardView, ...]
    camera: Camera
    eye_in_hand: bool
    sigma: float = 1.0
    unit: str = "px"

    @property
    def largest_error(self) -> float:
        """Error [px] of 5 mm at a distance of 0.6 m and a field of view of 60 degrees."""
        return 0.008 * self.camera.width

    @property
    def start(self) -> Array:
        """Poses from each view alone (PnP)."""
        T_camera_board = np.stack([board_pose(view, self.camera) for view in self.views])
        return np.stack([inverse(T) for T in T_camera_board]) if self.eye_in_hand else T_camera_board

    def residuals(self, T_static_moving: Array) -> list[Array]:
        """Compute reprojection errors (2 N,) of each view, in standard deviations."""
        found = []
        for view, T in zip(self.views, T_static_moving, strict=True):
            T_camera_board = inverse(T) if self.eye_in_hand else T
            found.append((project(view.points, T_camera_board, self.camera) - view.pixels).reshape(-1) / self.sigma)
        return found

    def select(self, rows: NDArray[np.intp]) -> BoardMeasurement:
        """Implement :class:`Measurement`."""
        return BoardMeasurement(tuple(self.views[k] for k in rows), self.camera, self.eye_in_hand, self.sigma)

    def scaled(self, residuals: list[Array]) -> BoardMeasurement:
        """Implement :class:`Measurement`: half of the errors of a bad arm exceed ``sigma``, and count linearly."""
        return replace(self, sigma=max(1.0, self.sigma * float(np.median(np.abs(np.concatenate(residuals))))))

    def error(self, residuals: list[Array]) -> float:
        """Compute the median distance of a corner from its prediction [px]."""
        return self.sigma * float(np.median(np.linalg.norm(np.concatenate(residuals).reshape(-1, 2), axis=1)))


@dataclass(frozen=True, eq=False)
class PoseMeasurement:
    """Tracked poses of the moving frame.

    Args:
        T_static_moving: (V, 4, 4), such as T_world_camera of a map [m].
        sigma: standard deviations of a coordinate of the translation [m] and of the rotation [rad].
    """

    T_static_moving: Array
    sigma: tuple[float, float] = (0.005, 0.005)
    unit: str = "mm"

    @property
    def largest_error(self) -> float:
        """Error [mm] of a camera that lost its way."""
        return 20.0

    @property
    def start(self) -> Array:
        """The poses themselves."""
        return self.T_static_moving

    def residuals(self, T_static_moving: Array) -> list[Array]:
        """Compute translation and rotation vector (6,) of the error of each pose, in standard deviations."""
        R, t = self.T_static_moving[:, :3, :3], self.T_static_moving[:, :3, 3]
        shift = T_static_moving[:, :3, 3] - t
        turn = Rotation.from_matrix(R.transpose(0, 2, 1) @ T_static_moving[:, :3, :3]).as_rotvec()
        return list(np.hstack([shift / self.sigma[0], turn / self.sigma[1]]))

    def select(self, rows: NDArray[np.intp]) -> PoseMeasurement:
        """Implement :class:`Measurement`."""
        return PoseMeasurement(self.T_static_moving[rows], self.sigma)

    def scaled(self, residuals: list[Array]) -> PoseMeasurement:
        """Implement :class:`Measurement` with a robust standard deviation from the median magnitude."""
        r = np.abs(np.array(residuals))
        shift, turn = (float(1.4826 * np.median(part)) for part in (r[:, :3], r[:, 3:]))
        return PoseMeasurement(
            self.T_static_moving, (max(self.sigma[0] * shift, 1e-6), max(self.sigma[1] * turn, 1e-6))
        )

    def error(self, residuals: list[Array]) -> float:
        """Compute the median distance of a position from its prediction [mm]."""
        return 1e3 * self.sigma[0] * float(np.median(np.linalg.norm(np.array(residuals)[:, :3], axis=1)))


def board_pose(view: BoardView, camera: Camera) -> Array:
    """Compute T_camera_board (4, 4) of one view (PnP, refined by Levenberg-Marquardt)."""
    pixels, lens = view.pixels, np.array(camera.distortion)
    if camera.fisheye:
        straight = cv2.fisheye.undistortPoints(pixels.reshape(-1, 1, 2), camera.K, lens, P=camera.K)
        pixels, lens = np.asarray(straight, np.float64), np.zeros(0)
    _, r, t = cv2.solvePnP(view.points, pixels, camera.K, lens, flags=cv2.SOLVEPNP_IPPE)
    r, t = cv2.solvePnPRefineLM(view.points, pixels, camera.K, lens, r, t)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3_exp(r.reshape(3)), t.reshape(3)
    return T


def project(points: Array, T_camera_board: Array, camera: Camera) -> Array:
    """Project points (N, 3) [m] of the board into the image: (N, 2) [px]."""
    project_points = cv2.fisheye.projectPoints if camera.fisheye else cv2.projectPoints
    r, t = so3_log(T_camera_board[:3, :3]), T_camera_board[:3, 3].copy()
    pixels = project_points(points.reshape(-1, 1, 3), r, t, camera.K, np.array(camera.distortion))[0]
    return np.asarray(pixels, np.float64).reshape(-1, 2)
