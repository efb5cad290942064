"""The map as a collision field: how far a point or a sphere is from the Gaussians, and whether it may touch one."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from splatbot.collision.answers import ClearanceResult, MahalanobisResult, NeighboursResult
from splatbot.collision.evidence import Evidence
from splatbot.collision.inputs import rows, spheres
from splatbot.collision.solids import MIN_OPACITY, SCALE_FLOOR, SolidGate, check_opacities, solid_arrays
from splatbot.errors import InputError, NativeError
from splatbot.gaussians import GaussianModel, Snapshot

try:
    from splatbot._native import CollisionField
except ImportError as error:
    raise NativeError(
        f"cannot be loaded ({error}).", field="splatbot._native", hint="install splatbot with pip, which builds it"
    ) from error

__all__ = ["MIN_OPACITY", "SCALE_FLOOR", "GaussianCollisionField"]

VOXEL = 0.02  # [m] of the grid of lower bounds
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
        evidence: Evidence | None = None,
    ) -> None:
        if not 1e-3 <= n_sigma <= 1e3:
            raise InputError(f"is {n_sigma}.", field="n_sigma", hint="give standard deviations in 0.001..1000")
        model = source.model if isinstance(source, Snapshot) else source
        self.map_version = source.map_version if isinstance(source, Snapshot) else 0
        self.n_sigma = float(n_sigma)
        self.gate = SolidGate(min_opacity, min_observations)
        check_opacities(model)
        # A solid Gaussian has a name, which it keeps from field to field while its row in the model may change.
        self._rows = np.flatnonzero(self.gate.solid(model, evidence))  # by name
        self._names = np.full(len(model), -1, np.int32)  # by row
        self._names[self._rows] = np.arange(len(self._rows), dtype=np.int32)
        s = solid_arrays(model, self._rows, self._names[self._rows])
        self.native = CollisionField(
            s.means, s.quats, s.scales, s.names, n_sigma=self.n_sigma, voxel=VOXEL, max_voxels=MAX_VOXELS
        )

    def updated(
        self,
        source: GaussianModel | Snapshot,
        changed: ArrayLike | Tensor,
        *,
        previous: ArrayLike | Tensor | None = None,
        evidence: Evidence | None = None,
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
        names, rows = self._carried(model, changed, previous)
        part = model.select(torch.from_numpy(rows))
        check_opacities(part)
        here = self.gate.solid(part, None if evidence is None else evidence.select(rows))
        solid, was = rows[here], names[rows]
        names[rows[~here]] = -1
        fresh = solid[was[here] < 0]
        names[fresh] = len(self._rows) + np.arange(len(fresh), dtype=np.int32)
        table = np.concatenate([self._rows, fresh])
        if previous is None and len(model) >= len(self._names):
            gone = was[~here & (was >= 0)]
            table[gone] = -1
        else:
            table[:] = -1
            table[names[names >= 0]] = np.flatnonzero(names >= 0)
            gone = np.flatnonzero((table[: len(self._rows)] < 0) & (self._rows >= 0)).astype(np.int32)
        s = solid_arrays(model, solid, names[solid])
        field = copy.copy(self)
        field.map_version = source.map_version if isinstance(source, Snapshot) else self.map_version + 1
        field._names = names
        field._rows = table
        field.native = self.native.updated(gone, s.means, s.quats, s.scales, s.names)
        return field

    def added_since(self, earlier: GaussianCollisionField) -> GaussianCollisionField:
        """A field of what ``earlier`` has not: only that can be in the way of a path that was free of ``earlier``.

        Compared by geometry, block by block; blocks that both share cost nothing.

        Raises:
            InputError: the two differ in n_sigma.
        """
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
        return len(self._names)

    @property
    def nbytes(self) -> int:
        """Bytes of the ellipsoids, the tree, the grid and the table of rows."""
        return int(self.native.bytes) + self._rows.nbytes + self._names.nbytes

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

    def _carried(
        self, model: GaussianModel, changed: ArrayLike | Tensor, previous: ArrayLike | Tensor | None
    ) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """The names (N,) that Gaussians bring from this field, -1 for none, and the rows that must be looked at."""
        n, known = len(model), len(self._names)
        dirty = np.asarray(changed)
        if dirty.shape != (n,) or dirty.dtype != np.bool_:
            raise InputError(f"is {dirty.dtype} {dirty.shape}.", field="changed", hint=f"give ({n},) booleans")
        if previous is None:
            names = np.full(n, -1, np.int32)
            names[: min(n, known)] = self._names[:n]
            new = np.arange(min(n, known), n)
            return names, np.concatenate([np.flatnonzero(dirty[: min(n, known)]), new])
        before = np.asarray(previous).astype(np.int64)
        if before.shape != (n,) or (n and (before.min() < -1 or before.max() >= known)):
            hint = f"give ({n},) rows in -1..{known - 1}"
            raise InputError("names a row that was not there.", field="previous", hint=hint)
        count = np.bincount(before[before >= 0], minlength=1)
        if count.max() > 1:
            raise InputError(
                "names a row twice.", field="previous", hint="give each row of the earlier map at most once"
            )
        names = np.full(n, -1, np.int32)
        names[before >= 0] = self._names[before[before >= 0]]
        return names, np.flatnonzero(dirty | (before < 0))

    def rows_of(self, names: NDArray[np.int32]) -> NDArray[np.int64]:
        """Rows of the model of the native field's names; -1 stays -1."""
        if not len(self._rows):
            return np.full(names.shape, -1, dtype=np.int64)
        return np.where(names >= 0, self._rows[names], -1)


def _checked_cut(cut: float) -> float:
    if not cut >= 0.0:
        raise InputError(f"is {cut}.", field="cut", hint="give metres, 0 or more")
    return cut
