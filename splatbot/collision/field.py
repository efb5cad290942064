"""The map as a collision field: distance of points and spheres from the Gaussians, and collision checks."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from splatbot.collision.answers import ClearanceResult, MahalanobisResult, NeighboursResult
from splatbot.collision.gaussian_ids import GaussianIdMap
from splatbot.collision.inputs import rows, spheres
from splatbot.collision.solids import MIN_OPACITY, SCALE_FLOOR, SolidGate, check_opacities, solid_arrays
from splatbot.collision.visibility import VisibilityEvidence
from splatbot.errors import InputError, NativeError
from splatbot.gaussians import GaussianModel, Snapshot

try:
    from splatbot._native import CollisionField
except ImportError as error:
    raise NativeError(
        f"cannot be loaded ({error}).", field="splatbot._native", hint="install splatbot with pip, which builds it"
    ) from error

__all__ = ["MIN_OPACITY", "SCALE_FLOOR", "GaussianCollisionField"]


@dataclass(frozen=True)
class FieldConstants:
    """Constants of the grid of lower bounds.

    Args:
        voxel: [m] edge length of a voxel.
        packed_voxel: [m] edge length of a voxel of a packed field.
        max_voxels: largest size of the grid, 4 MB; a larger map has larger voxels.
    """

    voxel: float = 0.02
    packed_voxel: float = 0.025
    max_voxels: int = 2_000_000


CONSTANTS = FieldConstants()


class GaussianCollisionField:
    """Collision queries against an immutable copy of a map.

    The solid of a Gaussian is its ellipsoid at ``n_sigma`` standard deviations, each at least ``SCALE_FLOOR``. "Free"
    is certified for these ellipsoids: distances are lower bounds that include the rounding of float32.

    A Gaussian has the mean μ, the rotation R and the scales S. A point p has the local coordinates v = Rᵀ (p - μ)::

        Mahalanobis distance   |S⁻¹ v|
        signed distance        max over |n| = 1 of  n·v - h(n),   h(n) = n_sigma |S n|

    The maximizing normal n is found by Hebden's iteration on the secular equation. The nearest Gaussian by Mahalanobis
    distance is found in float32; its distance is computed in float64 from the float32 values of the model.

    Args:
        source: a model (``map_version`` 0) or a snapshot.
        n_sigma: standard deviations at which the surface of a Gaussian lies.
        min_opacity: Gaussians of lower opacity are ignored.
        min_observations: Gaussians that the depth of fewer keyframes supports are ignored.
        evidence: Gaussians with more passes than hits are ignored. If None, visibility is not checked.
        packed: store each ellipsoid in 18 bytes instead of 56. All distances are reduced by the packing error, so that
            "free" stays certain. They are then smaller by up to 0.05 mm plus 2.6 % of the nearest Gaussian's longest
            semi-axis. Gaussians with semi-axes above 0.125 m are not packed. Mahalanobis distances refer to the packed
            Gaussians, and an update is slower.

    Raises:
        InputError: a mean, scale, opacity or quaternion is not finite, or a quaternion is zero; the message names the
            row. Also if n_sigma is not in 1e-3..1e3, min_opacity is not in 0..1, or a value exceeds 1e6 m.
    """

    def __init__(
        self,
        source: GaussianModel | Snapshot,
        n_sigma: float = 2.0,
        *,
        min_opacity: float = MIN_OPACITY,
        min_observations: int = 1,
        evidence: VisibilityEvidence | None = None,
        packed: bool = False,
    ) -> None:
        if not 1e-3 <= n_sigma <= 1e3:
            raise InputError(f"is {n_sigma}.", field="n_sigma", hint="give standard deviations in 0.001..1000")
        model = source.model if isinstance(source, Snapshot) else source
        self.map_version = source.map_version if isinstance(source, Snapshot) else 0
        self.n_sigma = float(n_sigma)
        self.gate = SolidGate(min_opacity, min_observations)
        check_opacities(model)
        self.packed = packed
        self._names = GaussianIdMap(len(model))
        solid = np.flatnonzero(self.gate.solid(model, evidence))
        s = solid_arrays(model, solid, self._names.of(solid))
        self.native = CollisionField(
            s.means,
            s.quats,
            s.scales,
            s.names,
            n_sigma=self.n_sigma,
            voxel=CONSTANTS.packed_voxel if packed else CONSTANTS.voxel,
            max_voxels=CONSTANTS.max_voxels,
            packed=packed,
        )

    def updated(
        self,
        source: GaussianModel | Snapshot,
        changed: ArrayLike | Tensor,
        *,
        previous: ArrayLike | Tensor | None = None,
        evidence: VisibilityEvidence | None = None,
    ) -> GaussianCollisionField:
        """Return the field of a later map version, which shares unchanged Gaussians with this field.

        This field does not change. The results equal those of a new field with the same n_sigma and gates.

        Args:
            source: the later map.
            changed: (N,) bool, True for a new Gaussian and for a change of mean, shape, opacity or observations.
            previous: (N,) row of each Gaussian in the model of this field, -1 for a new one; rows that do not occur are
                removed. If None, rows keep their places, and further rows are new.
            evidence: visibility, see the class. If None, the visibility of changed Gaussians is not checked.

        Raises:
            InputError: a changed Gaussian is invalid, see the class, or an array does not fit the models.
        """
        model = source.model if isinstance(source, Snapshot) else source
        dirty = np.asarray(changed)
        if dirty.shape != (len(model),) or dirty.dtype != np.bool_:
            raise InputError(f"is {dirty.dtype} {dirty.shape}.", field="changed", hint=f"give ({len(model)},) booleans")
        names, new, gone = self._names.carried(len(model), previous)
        dirty = dirty.copy()
        dirty[new] = True
        rows = np.flatnonzero(dirty)
        part = model.select(torch.from_numpy(rows))
        check_opacities(part)
        here = self.gate.solid(part, None if evidence is None else evidence.select(rows))
        s = solid_arrays(model, rows[here], names.of(rows[here]))
        field = copy.copy(self)
        field.map_version = source.map_version if isinstance(source, Snapshot) else self.map_version + 1
        field._names = names
        removed = np.concatenate([gone, names.of(rows[~here])])
        field.native = self.native.updated(removed, s.means, s.quats, s.scales, s.names)
        return field

    def added_since(self, earlier: GaussianCollisionField) -> GaussianCollisionField:
        """Return a field of the Gaussians that ``earlier`` lacks.

        Only these can block a path that was free in ``earlier``. Gaussians are compared by geometry, block by block;
        shared blocks are skipped.

        Raises:
            InputError: the fields differ in n_sigma or in packing.
        """
        if earlier.packed != self.packed:
            raise InputError(f"is {earlier.packed}, not {self.packed}.", field="packed", hint="compare equal kinds")
        if earlier.n_sigma != self.n_sigma:
            raise InputError(
                f"is {earlier.n_sigma}, not {self.n_sigma}.", field="n_sigma", hint="compare fields of one kind"
            )
        field = copy.copy(self)
        field.native = self.native.added_since(earlier.native)
        return field

    def __len__(self) -> int:
        """Return the number of solid Gaussians, after the gates on opacity and observation."""
        return len(self.native)

    @property
    def rows(self) -> int:
        """Number of Gaussians of the model, ignored ones included."""
        return self._names.count

    @property
    def nbytes(self) -> int:
        """Memory of ellipsoids, trees, grid and identifier tables [bytes]."""
        return int(self.native.bytes) + self._names.nbytes

    def mahalanobis(self, points: ArrayLike | Tensor) -> MahalanobisResult:
        """Find the nearest Gaussian of each of ``points`` (P, 3) by Mahalanobis distance [m, world frame].

        Raises:
            InputError: the shape is not (P, 3) or a value is not finite (the message names the row).
        """
        distance, names = self.native.mahalanobis(rows(points, "points", 3, "world coordinates in metres"))
        return MahalanobisResult(distance.astype(np.float32), self.rows_of(names), self.map_version)

    def in_collision(self, points: ArrayLike | Tensor) -> NDArray[np.bool_]:
        """Check whether each of ``points`` (P, 3) or spheres (P, 4) may collide with a Gaussian (P,).

        Spheres are (x, y, z, radius) [m, world]. False is certain; true may be wrong if the clearance is below the
        error of :class:`ClearanceResult`.

        Raises:
            InputError: the shape is wrong, a value is not finite, or a radius is below 0.
        """
        hits: NDArray[np.uint8] = self.native.hits(*spheres(points))
        return hits.astype(np.bool_)

    def clearance(self, points: ArrayLike | Tensor, *, cut: float = np.inf) -> ClearanceResult:
        """Compute the signed distance of each of ``points`` (P, 3) or spheres (P, 4) to the nearest ellipsoid [m].

        Args:
            points: see :meth:`in_collision`.
            cut: search distance [m]; a smaller one is faster.

        Raises:
            InputError: the points are invalid, or the cut is negative or NaN.
        """
        distance, gradient, witness, names = self.native.nearest(*spheres(points), _checked_cut(cut))
        witness[names < 0] = np.nan
        return ClearanceResult(distance, gradient, witness, self.rows_of(names), self.map_version)

    def nearest(self, points: ArrayLike | Tensor, k: int, *, cut: float = np.inf) -> NeighboursResult:
        """Find the ``k`` (1..64) nearest Gaussians of each of ``points`` (P, 3) or spheres (P, 4) by signed distance.

        Raises:
            InputError: the points or the cut are invalid, or k is out of range.
        """
        if not 1 <= k <= 64:
            raise InputError(f"is {k}.", field="k", hint="give 1..64")
        distance, names = self.native.k_nearest(*spheres(points), k, _checked_cut(cut))
        return NeighboursResult(distance, self.rows_of(names), self.map_version)

    def rows_of(self, names: NDArray[np.int32]) -> NDArray[np.int64]:
        """Map identifiers of the native field to rows of the model; -1 stays -1."""
        return self._names.rows(names)


def _checked_cut(cut: float) -> float:
    if not cut >= 0.0:
        raise InputError(f"is {cut}.", field="cut", hint="give metres, 0 or more")
    return cut
