"""The map as a collision field: how many standard deviations a point is from the nearest Gaussian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from splatbot.errors import InputError, NativeError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import quat_to_rotation

try:
    from splatbot._native import MahalanobisField
except ImportError as error:
    raise NativeError(
        f"cannot be loaded ({error}).", field="splatbot._native", hint="install splatbot with pip, which builds it"
    ) from error

# A mapped surface is measured to a fraction of a millimetre at best. With this floor the 2σ ellipsoid reaches at least
# 0.1 mm to either side of a surface, float32 keeps its digits, and a scale of 0 is safe: it only ever fattens.
SCALE_FLOOR = 5e-5  # [m]
# Below this opacity a Gaussian contributes to no pixel (the rasterizer's cut), so nobody could have seen it.
MIN_OPACITY = 1.0 / 255.0


@dataclass(frozen=True)
class MahalanobisResult:
    """Answers for P points.

    Args:
        distance: (P,) float32, in standard deviations of the nearest Gaussian; infinity where the map is empty.
        index: (P,) int64, that Gaussian's row in the model (the lowest of equals), -1 where the map is empty.
        map_version: the state of the map that was asked.
    """

    distance: NDArray[np.float32]
    index: NDArray[np.int64]
    map_version: int


class GaussianCollisionField:
    """Collision queries against an immutable copy of a map.

    A point p is at Mahalanobis distance |S⁻¹ Rᵀ (p - μ)| from a Gaussian of mean μ, rotation R and scales S (each at
    least ``SCALE_FLOOR``); it collides where that is at most ``n_sigma`` for any Gaussian. Computed in float32 about
    the map's centre, in that factored form: with L the distance [m] from the centre to the point or the farthest mean,
    whichever is larger, and s the least scale, the error against float64 is below 1.5e-6 L / s standard deviations,
    that is 1.5 µm per metre of L along the thinnest axis.

    Args:
        source: a model (``map_version`` 0) or a snapshot.
        n_sigma: where the surface of a Gaussian is taken to be.
        min_opacity: Gaussians fainter than this are air, as are those without an observation.

    Raises:
        InputError: a mean, scale, opacity or quaternion is not finite, or a quaternion is zero (the message names the
            row); n_sigma is not positive or min_opacity not in 0..1.
    """

    def __init__(
        self, source: GaussianModel | Snapshot, n_sigma: float = 2.0, *, min_opacity: float = MIN_OPACITY
    ) -> None:
        if not 0.0 < n_sigma < np.inf:
            raise InputError(f"is {n_sigma}.", field="n_sigma", hint="give a positive number of standard deviations")
        if not 0.0 <= min_opacity <= 1.0:
            raise InputError(f"is {min_opacity}.", field="min_opacity", hint="give a value in 0..1")
        model = source.model if isinstance(source, Snapshot) else source
        self.map_version = source.map_version if isinstance(source, Snapshot) else 0
        self.n_sigma = float(n_sigma)
        means, quats = _column(model.means, "means"), _column(model.quats, "quats")
        scales, opacities = np.exp(_column(model.log_scales, "log_scales")), _column(model.opacities, "opacity_logits")
        zero = np.flatnonzero(~quats.any(axis=1))
        if zero.size:
            raise InputError(f"row {zero[0]} is zero.", field="quats", hint="use (1, 0, 0, 0) for no rotation")
        observed = model.observations.numpy() > 0  # a Gaussian that no depth supports only carries colour
        self._rows = np.flatnonzero((opacities >= min_opacity) & observed)
        means, quats, scales = means[self._rows], quats[self._rows], scales[self._rows]
        self._centre = (means.min(axis=0) + means.max(axis=0)) / 2 if len(means) else np.zeros(3)
        whitening = quat_to_rotation(quats).swapaxes(-1, -2) / np.maximum(scales, SCALE_FLOOR)[:, :, None]
        self._field = MahalanobisField(self._local(means), np.ascontiguousarray(whitening, dtype=np.float32))

    def __len__(self) -> int:
        """Number of Gaussians that count, after the gates on opacity and observation."""
        return len(self._rows)

    def mahalanobis(self, points: ArrayLike | Tensor) -> MahalanobisResult:
        """The nearest Gaussian of each of ``points`` (P, 3) [m, world frame], numpy or torch.

        Raises:
            InputError: the shape is not (P, 3) or a value is not finite (the message names the row).
        """
        local = self._local(_points(points))
        distance = np.empty(len(local), dtype=np.float32)
        kept = np.empty(len(local), dtype=np.int32)
        self._field.nearest(local, distance, kept)
        index = np.full(len(local), -1, dtype=np.int64)
        index[kept >= 0] = self._rows[kept[kept >= 0]]
        return MahalanobisResult(distance, index, self.map_version)

    def in_collision(self, points: ArrayLike | Tensor) -> NDArray[np.bool_]:
        """Whether each of ``points`` (P, 3) [m, world frame] lies within ``n_sigma`` of any Gaussian: (P,).

        Raises:
            InputError: as :meth:`mahalanobis`.
        """
        return self.mahalanobis(points).distance <= self.n_sigma

    def _local(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Points about the map's centre: a map far from the origin keeps its digits in float32."""
        return np.ascontiguousarray(points - self._centre, dtype=np.float32)


def _column(values: Tensor, name: str) -> NDArray[np.float64]:
    array = values.detach().numpy().astype(np.float64)
    bad = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if bad.any():
        raise InputError(
            f"row {int(np.argmax(bad))} is not finite.", field=name, hint="remove it with GaussianModel.select"
        )
    return array


def _points(points: ArrayLike | Tensor) -> NDArray[np.float64]:
    array = np.asarray(points.detach() if isinstance(points, Tensor) else points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"is {array.shape}.", field="points", hint="give (P, 3) world coordinates in metres")
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise InputError(f"row {int(np.argmax(bad))} is not finite.", field="points", hint="give finite metres")
    return array
