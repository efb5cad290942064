"""The map as a collision field: how far a point or a sphere is from the Gaussians, and whether it may touch one."""

from __future__ import annotations

import copy

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

VOXEL, PACKED_VOXEL = 0.02, 0.025  # [m] of the grid of lower bounds
MAX_VOXELS = 2_000_000  # of that grid: 4 MB; beyond, voxels grow


class GaussianCollisionField:
    """Collision queries against an immutable copy of a map.

    A Gaussian's solid is its ellipsoid at ``n_sigma`` standard deviations (each at least ``SCALE_FLOOR``): what lies
    within it. "Free" is certified for these ellipsoids: distances come from below, with float32's rounding taken off.
    Signed distance to a convex body is the largest n·v - h(n) over unit n, h its support function; the n that attains
    it is found by Hebden's iteration on the secular equation.

    A point p is at Mahalanobis distance |S⁻¹ Rᵀ (p - μ)| from a Gaussian of mean μ, rotation R and scales S; the
    winner is found in float32 and its distance computed in float64 from the model's float32 values.

    Args:
        source: a model (``map_version`` 0) or a snapshot.
        n_sigma: where the surface of a Gaussian is taken to be.
        min_opacity: Gaussians fainter than this are air.
        min_observations: so are those that fewer keyframes' depth supports.
        evidence: so are those that were seen through more often than hit; None: whether is not asked.
        packed: keep the ellipsoids in 18 bytes each in place of 56. What that may move a surface by is taken off
            every distance, so that "free" stays certain; distances then come out too small by up to 0.05 mm more,
            and 2.6 % of the nearest Gaussian's longest semi-axis. Semi-axes above 0.125 m are never packed.
            Mahalanobis distances are those of the packed Gaussians, and an update costs more.

    Raises:
        InputError: a mean, scale, opacity or quaternion is not finite, or a quaternion is zero (the message names the
            row); n_sigma is not in 1e-3..1e3, min_opacity not in 0..1, or a value is above 1e6 m.
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
            voxel=PACKED_VOXEL if packed else VOXEL,
            max_voxels=MAX_VOXELS,
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
        """The field of a later state of the map, which shares what did not change; this one stays as it is.

        The answers are those of a field built anew with the same n_sigma and gates.

        Args:
            source: the later map.
            changed: (N,) bool, Gaussians that moved, changed their shape, opacity or observations, or are new.
            previous: (N,) the row that each Gaussian had in this field's model, -1 for a new one; None: rows stay
                what they were, and further ones are new. Rows of this field's model that nobody had are removed.
            evidence: as at first; None: changed Gaussians are not asked for it.

        Raises:
            InputError: as the constructor, for what changed; changed or previous do not fit the models.
        """
        model = source.model if isinstance(source, Snapshot) else source
        dirty = np.asarray(changed)
        if dirty.shape != (len(model),) or dirty.dtype != np.bool_:
            raise InputError(f"is {dirty.dtype} {dirty.shape}.", field="changed", hint=f"give ({len(model)},) booleans")
        names, new, gone = self._names.carried(len(model), previous)
        asked = dirty.copy()
        asked[new] = True
        rows = np.flatnonzero(asked)
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
        """A field of what ``earlier`` has not: only that can be in the way of a path that was free of ``earlier``.

        Compared by geometry, block by block; blocks that both share cost nothing.

        Raises:
            InputError: the two differ in n_sigma, or one of them is packed.
        """
        if earlier.packed != self.packed:
            raise InputError(f"is {earlier.packed}, not {self.packed}.", field="packed", hint="ask fields of one kind")
        if earlier.n_sigma != self.n_sigma:
            raise InputError(
                f"is {earlier.n_sigma}, not {self.n_sigma}.", field="n_sigma", hint="ask fields of one kind"
            )
        field = copy.copy(self)
        field.native = self.native.added_since(earlier.native)
        return field

    def __len__(self) -> int:
        """Number of Gaussians that count, after the gates on opacity and observation."""
        return len(self.native)

    @property
    def rows(self) -> int:
        """Number of Gaussians of the model, air included."""
        return self._names.count

    @property
    def nbytes(self) -> int:
        """Bytes of all that answers need: ellipsoids, trees, grid, and tables of names where there are any."""
        return int(self.native.bytes) + self._names.nbytes

    def mahalanobis(self, points: ArrayLike | Tensor) -> MahalanobisResult:
        """The nearest Gaussian of each of ``points`` (P, 3) [m, world frame], numpy or torch.

        Raises:
            InputError: the shape is not (P, 3) or a value is not finite (the message names the row).
        """
        distance, names = self.native.mahalanobis(rows(points, "points", 3, "world coordinates in metres"))
        return MahalanobisResult(distance.astype(np.float32), self.rows_of(names), self.map_version)

    def in_collision(self, points: ArrayLike | Tensor) -> NDArray[np.bool_]:
        """Whether each of ``points`` (P, 3) or spheres (P, 4) = (x, y, z, radius) [m, world] may touch a Gaussian (P,).

        False is certain; true may be wrong for what misses an ellipsoid by less than the error of
        :class:`ClearanceResult`.

        Raises:
            InputError: another shape, a value that is not finite, a radius below 0.
        """
        hits: NDArray[np.uint8] = self.native.hits(*spheres(points))
        return hits.astype(np.bool_)

    def clearance(self, points: ArrayLike | Tensor, *, cut: float = np.inf) -> ClearanceResult:
        """The signed distance of each of ``points`` (P, 3) or spheres (P, 4) to the nearest ellipsoid [m].

        Args:
            points: as in :meth:`in_collision`.
            cut: how far to look [m]; what is farther has no answer, which is quicker.

        Raises:
            InputError: as :meth:`in_collision`; the cut is negative or NaN.
        """
        distance, gradient, witness, names = self.native.nearest(*spheres(points), _checked_cut(cut))
        witness[names < 0] = np.nan
        return ClearanceResult(distance, gradient, witness, self.rows_of(names), self.map_version)

    def nearest(self, points: ArrayLike | Tensor, k: int, *, cut: float = np.inf) -> NeighboursResult:
        """The ``k`` (1..64) nearest Gaussians of each of ``points`` (P, 3) or spheres (P, 4), by signed distance.

        Raises:
            InputError: as :meth:`clearance`; k is out of range.
        """
        if not 1 <= k <= 64:
            raise InputError(f"is {k}.", field="k", hint="give 1..64")
        distance, names = self.native.k_nearest(*spheres(points), k, _checked_cut(cut))
        return NeighboursResult(distance, self.rows_of(names), self.map_version)

    def rows_of(self, names: NDArray[np.int32]) -> NDArray[np.int64]:
        """Rows of the model of the native field's names; -1 stays -1."""
        return self._names.rows(names)


def _checked_cut(cut: float) -> float:
    if not cut >= 0.0:
        raise InputError(f"is {cut}.", field="cut", hint="give metres, 0 or more")
    return cut
