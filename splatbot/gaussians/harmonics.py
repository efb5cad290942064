"""Degree-0 spherical harmonics: between RGB in [0, 1] and the DC coefficient that 3DGS stores."""

from __future__ import annotations

from torch import Tensor

SH_C0 = 0.28209479177387814  # 1 / (2 √π)


def rgb_to_sh(rgb: Tensor) -> Tensor:
    """DC coefficients of colours in [0, 1]; any shape."""
    return (rgb - 0.5) / SH_C0


def sh_to_rgb(sh: Tensor) -> Tensor:
    """Colours of DC coefficients, not clamped; any shape."""
    return sh * SH_C0 + 0.5
