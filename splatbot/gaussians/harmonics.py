"""Degree-0 spherical harmonics: between RGB in [0, 1] and the DC coefficient that 3DGS stores."""

from __future__ import annotations

from torch import Tensor

SH_C0 = 0.28209479177387814  # 1 / (2 √π)


def rgb_to_sh(rgb: Tensor) -> Tensor:
    """Convert colours to DC coefficients of spherical harmonics; colours in [0, 1] of any shape."""
    return (rgb - 0.5) / SH_C0


def sh_to_rgb(sh: Tensor) -> Tensor:
    """Convert DC coefficients to colours, not clamped; any shape."""
    return sh * SH_C0 + 0.5
