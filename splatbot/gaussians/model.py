"""The map: a set of 3D Gaussians as 3DGS stores them, plus the bookkeeping of depth fusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from splatbot.errors import InputError
from splatbot.gaussians.harmonics import rgb_to_sh, sh_to_rgb

# Opacities of exactly 0 and 1 have infinite logits; these bounds are below an 8-bit image's resolution.
OPACITY_MIN, OPACITY_MAX = 1e-6, 1.0 - 1e-6
SCALE_MIN = 1e-9  # [m]; a scale of exactly 0 has no logarithm


@dataclass(eq=False)
class GaussianModel:
    """N Gaussians; world frame, metres; float32 CPU tensors.

    Args:
        means: (N, 3) [m].
        quats: (N, 4) wxyz, any positive norm.
        log_scales: (N, 3), natural logarithm of the standard deviations [m].
        opacity_logits: (N,).
        sh: (N, K, 3), K = (degree + 1)²; entry 0 is the DC term.
        observations: (N,) int32, how many keyframes support the Gaussian.
        anchors: (N,) int32, keyframe that created it, -1 for none.
        uncertainty: (N,) standard deviation of the mean along the shortest axis [m] after depth fusion. 0 marks an
            exact mean, as in a map from another program.
        misses: (N,) int32, recent frames that saw through it, less recent frames that support it.

    Raises:
        InputError: shapes do not fit together.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor
    observations: Tensor
    anchors: Tensor
    uncertainty: Tensor = None  # type: ignore[assignment]  # zeros
    misses: Tensor = None  # type: ignore[assignment]  # zeros

    def __post_init__(self) -> None:
        n = len(self.means)
        if self.uncertainty is None:
            self.uncertainty = torch.zeros(n)
        if self.misses is None:
            self.misses = torch.zeros(n, dtype=torch.int32)
        shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,)}
        shapes |= dict.fromkeys(("observations", "anchors", "uncertainty", "misses"), (n,))
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise InputError(f"is {tuple(getattr(self, name).shape)}, expected {shape}.", field=name)
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[1] not in (1, 4, 9, 16, 25):
            raise InputError(f"is {tuple(self.sh.shape)}, expected ({n}, (degree + 1)², 3).", field="sh")

    @classmethod
    def empty(cls, sh_degree: int = 0) -> GaussianModel:
        """Return a model of no Gaussians."""
        z = torch.zeros
        ints = torch.zeros(0, dtype=torch.int32)
        return cls(z(0, 3), z(0, 4), z(0, 3), z(0), z(0, (sh_degree + 1) ** 2, 3), ints, ints.clone())

    @classmethod
    def from_activated(
        cls,
        *,
        means: ArrayLike | Tensor,
        quats: ArrayLike | Tensor,
        scales: ArrayLike | Tensor,
        opacities: ArrayLike | Tensor,
        colors: ArrayLike | Tensor,
    ) -> GaussianModel:
        """Return a model from physical units: scales (N, 3) [m], opacities (N,) in 0..1, colors (N, 3) RGB in 0..1.

        Raises:
            InputError: a value is not finite or out of range, or a quaternion is zero.
        """

        def tensor(name: str, value: ArrayLike | Tensor) -> Tensor:
            t = value.detach() if isinstance(value, Tensor) else torch.as_tensor(np.asarray(value))
            t = t.to(torch.float32).contiguous()
            bad = ~torch.isfinite(t)
            if bad.any():
                raise InputError(f"row {int(bad.nonzero()[0, 0])} is not finite.", field=name)
            return t.clone()

        m, q, s = tensor("means", means), tensor("quats", quats), tensor("scales", scales)
        o, c = tensor("opacities", opacities), tensor("colors", colors)
        if q.numel() and (q.abs().amax(-1) == 0).any():
            raise InputError("has a zero quaternion.", field="quats", hint="use (1, 0, 0, 0) for no rotation")
        if (s < 0).any():
            raise InputError("has negative values.", field="scales", hint="give standard deviations in metres")
        for name, t in (("opacities", o), ("colors", c)):
            if t.numel() and (t.min() < 0 or t.max() > 1):
                raise InputError(f"spans {t.min():.3g}..{t.max():.3g}.", field=name, hint="give values in 0..1")
        n = len(m)
        return cls(
            means=m,
            quats=q,
            log_scales=s.clamp_min(SCALE_MIN).log(),
            opacity_logits=torch.logit(o.to(torch.float64).clamp(OPACITY_MIN, OPACITY_MAX)).float(),
            sh=rgb_to_sh(c)[:, None, :],
            observations=torch.ones(n, dtype=torch.int32),
            anchors=torch.full((n,), -1, dtype=torch.int32),
        )

    @classmethod
    def load(cls, path: str | Path) -> GaussianModel:
        """Read a map from any supported format (see :mod:`splatbot.formats`).

        Raises:
            FormatError: the file is missing, damaged or of an unknown format.
        """
        from splatbot.formats import load_gaussians

        return load_gaussians(path)

    def save(self, path: str | Path) -> None:
        """Write the map in the format of the suffix (see :mod:`splatbot.formats`)."""
        from splatbot.formats import save_gaussians

        save_gaussians(self, path)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def scales(self) -> Tensor:
        """Standard deviations (N, 3) [m]."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities (N,) in 0..1."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def colors(self) -> Tensor:
        """View-independent RGB (N, 3) in 0..1 (DC term only)."""
        return sh_to_rgb(self.sh[:, 0]).clamp(0.0, 1.0)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(t.numel() * t.element_size() for t in self._tensors())

    def clone(self) -> GaussianModel:
        """Return a deep copy that shares nothing with this model."""
        return GaussianModel(*(t.detach().clone() for t in self._tensors()))

    def select(self, index: Tensor) -> GaussianModel:
        """Return a model of the Gaussians that ``index`` (a boolean mask (N,) or indices) names, copied."""
        return GaussianModel(*(t[index] for t in self._tensors()))

    @staticmethod
    def concatenate(models: Sequence[GaussianModel]) -> GaussianModel:
        """Return the union of models, in order; harmonics of lower degrees than the highest are continued by zeros."""
        most = max(m.sh.shape[1] for m in models)
        padded = [replace(m, sh=torch.nn.functional.pad(m.sh, (0, 0, 0, most - m.sh.shape[1]))) for m in models]
        columns = zip(*(m._tensors() for m in padded), strict=True)
        return GaussianModel(*(torch.cat(column) for column in columns))

    def _tensors(self) -> tuple[Tensor, ...]:
        return tuple(getattr(self, f.name) for f in fields(self))
