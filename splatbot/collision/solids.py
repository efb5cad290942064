"""Solid Gaussians of a map: gates on opacity and observation, and the input arrays of the native field."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.collision.visibility import VisibilityEvidence
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel

# A surface is measured to a fraction of a millimetre at best. With this floor the 2σ ellipsoid extends at least 0.1 mm
# to either side of it. The floor only enlarges ellipsoids, and makes a scale of 0 safe.
SCALE_FLOOR = 5e-5  # [m]
# The rasterizer ignores Gaussians of lower opacity, so no image can show them.
MIN_OPACITY = 1.0 / 255.0
MAX_VALUE = 1e6  # [m] largest mean or scale; squares of larger values overflow in float32


@dataclass(frozen=True)
class SolidGate:
    """Criteria of solid Gaussians; all others are ignored.

    Args:
        min_opacity: smallest opacity.
        min_observations: smallest number of keyframes whose depth supports the Gaussian; without any it only carries
            colour.

    Raises:
        InputError: a bound is out of range.
    """

    min_opacity: float = MIN_OPACITY
    min_observations: int = 1

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_opacity <= 1.0:
            raise InputError(f"is {self.min_opacity}.", field="min_opacity", hint="give a value in 0..1")
        if self.min_observations < 0:
            raise InputError(f"is {self.min_observations}.", field="min_observations", hint="give 0 or more keyframes")

    def solid(self, model: GaussianModel, evidence: VisibilityEvidence | None = None) -> NDArray[np.bool_]:
        """Return whether each Gaussian (N,) is solid; one with more passes than hits is not.

        Raises:
            InputError: the evidence has another number of Gaussians.
        """
        if evidence is not None and len(evidence.hits) != len(model):
            raise InputError(f"has {len(evidence.hits)} rows.", field="evidence", hint=f"gather it for {len(model)}")
        solid = (model.opacities.detach() >= self.min_opacity) & (model.observations >= self.min_observations)
        found = np.asarray(solid.numpy(), dtype=np.bool_)
        return found if evidence is None else found & ~evidence.seen_through


@dataclass(frozen=True)
class SolidArrays:
    """Input of the native field: float32, C-contiguous.

    Args:
        means: (N, 3) [m, world].
        quats: (N, 4) wxyz, any norm.
        scales: (N, 3) standard deviations [m], at least ``SCALE_FLOOR``.
        names: (N,) int32, identifiers.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    names: NDArray[np.int32]


def solid_arrays(model: GaussianModel, rows: NDArray[np.int64], names: NDArray[np.int32]) -> SolidArrays:
    """Extract the Gaussians ``rows`` (N,), sorted and distinct, of a model with the identifiers ``names`` (N,).

    Raises:
        InputError: a mean, scale, opacity or quaternion is not finite, a quaternion is zero, or a value exceeds 1e6 m.
            The message names the row. A damaged Gaussian would otherwise count as free space.
    """
    columns = [model.means, model.quats, model.log_scales]
    if len(rows) != len(model):
        chosen = torch.from_numpy(rows)
        columns = [values[chosen] for values in columns]
    for name, values in zip(("means", "quats", "log_scales"), columns, strict=True):
        _check_finite(name, values, rows)
    means, quats, log_scales = (values.detach() for values in columns)
    zero = quats[:, 0] == 0.0
    if bool(zero.any()) and bool((zero := (quats == 0.0).all(dim=1)).any()):
        row = rows[int(zero.nonzero()[0, 0])]
        raise InputError(f"row {row} is zero.", field="quats", hint="use (1, 0, 0, 0) for no rotation")
    scales = log_scales.exp().clamp_min_(SCALE_FLOOR)
    if len(rows) and max(float(scales.amax()), float(means.amax()), -float(means.amin())) > MAX_VALUE:
        raise InputError(f"has values above {MAX_VALUE:g} m.", field="means, scales", hint="give metres")
    return SolidArrays(_array(means), _array(quats), _array(scales), np.ascontiguousarray(names, dtype=np.int32))


def check_opacities(model: GaussianModel) -> None:
    """Refuse opacities that are not finite; such Gaussians would count as free space.

    Raises:
        InputError: the message names the row.
    """
    _check_finite("opacity_logits", model.opacity_logits, np.arange(len(model)))


def _check_finite(name: str, values: Tensor, rows: NDArray[np.int64]) -> None:
    if math.isfinite(float(values.detach().sum(dtype=torch.float64))):  # cannot overflow in float64
        return
    bad = ~torch.isfinite(values).reshape(len(values), -1).all(dim=1)
    raise InputError(
        f"row {rows[int(bad.nonzero()[0, 0])]} is not finite.", field=name, hint="remove it with GaussianModel.select"
    )


def _array(values: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(values.to(torch.float32).numpy())
