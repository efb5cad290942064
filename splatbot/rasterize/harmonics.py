"""Real spherical harmonics in plain torch, by recurrence: independent of the kernels' polynomials."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def harmonics_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate the real harmonics (..., (degree + 1)²), with the signs of 3DGS, in unit directions (..., 3).

    Index l² + l + m holds degree l and order m: √2 K cos(mφ) P_l^m(z) for m > 0 and √2 K sin(|m|φ) P_l^|m|(z) for
    m < 0. K² is (2l + 1) (l - |m|)! / (4π (l + |m|)!), and P has the Condon-Shortley phase.
    """
    x, y, z = directions.unbind(-1)
    values: dict[int, Tensor] = {}
    cosine, sine = torch.ones_like(x), torch.zeros_like(x)  # of m times the longitude, times sin(colatitude)^m
    diagonal = 1.0  # P_m^m / sin(colatitude)^m
    for m in range(degree + 1):
        before, legendre = torch.zeros_like(z), torch.full_like(z, diagonal)
        for order in range(m, degree + 1):
            norm = (2 * order + 1) * math.factorial(order - m) / (4 * math.pi * math.factorial(order + m))
            scale = math.sqrt(norm * (1 if m == 0 else 2))
            values[order * order + order + m] = scale * cosine * legendre
            if m > 0:
                values[order * order + order - m] = scale * sine * legendre
            ahead = ((2 * order + 1) * z * legendre - (order + m) * before) / (order + 1 - m)
            before, legendre = legendre, ahead
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        diagonal *= -(2 * m + 1)
    return torch.stack([values[k] for k in range((degree + 1) ** 2)], -1)
