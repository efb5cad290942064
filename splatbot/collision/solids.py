"""What of a map is solid: the gates on opacity and observation, and the arrays that the native field takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel

# A mapped surface is measured to a fraction of a millimetre at best. With this floor the 2σ ellipsoid reaches at least
# 0.1 mm to either side of a surface, and a scale of 0 is safe: it only ever fattens.
SCALE_FLOOR = 5e-5  # [m]
# Below this opacity a Gaussian contributes to no pixel (the rasterizer's cut), so nobody could have seen it.
MIN_OPACITY = 1.0 / 255.0
LARGEST = 1e6  # [m] of means and scales: beyond it squares of float32 overflow


@dataclass(frozen=True)
class SolidGate:
    """Which Gaussians are solid; the others are air.

    Args:
        min_opacity: fainter ones are air.
        min_observations: so are those that fewer keyframes' depth supports; a Gaussian without any only carries colour.

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

    def solid(self, model: GaussianModel) -> NDArray[np.bool_]:
        """Whether each Gaussian (N,) is solid."""
        return ((model.opacities >= self.min_opacity) & (model.observations >= self.min_observations)).numpy()


@dataclass(frozen=True)
class SolidArrays:
    """Gaussians as the native field takes them: float32, C-contiguous.

    Args:
        means: (N, 3) [m, world].
        quats: (N, 4) wxyz, any norm.
        scales: (N, 3) standard deviations [m], at least ``SCALE_FLOOR``.
        names: (N,) int32.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    names: NDArray[np.int32]


def solid_arrays(model: GaussianModel, rows: NDArray[np.int64], names: NDArray[np.int32]) -> SolidArrays:
    """The Gaussians ``rows`` (N,) of a model, under ``names`` (N,)."""
    chosen = torch.from_numpy(rows)
    scales = model.log_scales.detach()[chosen].exp().clamp_min(SCALE_FLOOR)
    if len(rows) and (float(scales.max()) > LARGEST or float(model.means.abs().max()) > LARGEST):
        raise InputError(f"has values above {LARGEST:g} m.", field="means, scales", hint="give metres")
    return SolidArrays(
        _array(model.means.detach()[chosen]),
        _array(model.quats.detach()[chosen]),
        _array(scales),
        np.ascontiguousarray(names, dtype=np.int32),
    )


def check_model(model: GaussianModel) -> None:
    """Refuse a damaged map: a Gaussian of NaN is never hit, which would read as free.

    Raises:
        InputError: a mean, scale, opacity or quaternion is not finite, or a quaternion is zero (with the row).
    """
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        values: Tensor = getattr(model, name).detach()
        if not bool(torch.isfinite(values).all()):
            bad = ~torch.isfinite(values).reshape(len(values), -1).all(dim=1)
            raise InputError(
                f"row {int(bad.nonzero()[0, 0])} is not finite.", field=name, hint="remove it with GaussianModel.select"
            )
    zero = (model.quats.detach() == 0.0).all(dim=1)
    if bool(zero.any()):
        raise InputError(
            f"row {int(zero.nonzero()[0, 0])} is zero.", field="quats", hint="use (1, 0, 0, 0) for no rotation"
        )


def _array(values: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(values.to(torch.float32).numpy())
