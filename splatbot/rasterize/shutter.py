"""Cameras read line by line: the shutter's kinds, and how a camera moves while it is open."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any

import torch
from torch import Tensor

from splatbot.errors import InputError

_MAX_TURN = math.pi / 2  # [rad] between the first and the last line; more than any camera does
_SMALL = 1e-4  # of 1 - cos(angle): below, series


class RollingShutterType(Enum):
    """Order in which a camera reads its lines; gsplat's names."""

    GLOBAL = 0
    ROLLING_TOP_TO_BOTTOM = 1
    ROLLING_LEFT_TO_RIGHT = 2
    ROLLING_BOTTOM_TO_TOP = 3
    ROLLING_RIGHT_TO_LEFT = 4


def shutter_of(value: Any) -> RollingShutterType:
    """Return the shutter of that name, global if None; accepts gsplat's own enumeration.

    Raises:
        InputError: an unknown name.
    """
    name = "GLOBAL" if value is None else value if isinstance(value, str) else getattr(value, "name", None)
    if not isinstance(name, str) or name not in RollingShutterType.__members__:
        names = ", ".join(RollingShutterType.__members__)
        raise InputError(f"is {value!r}.", field="rolling_shutter", hint=f"one of {names}")
    return RollingShutterType[name]


@dataclass(frozen=True)
class Motion:
    """From one pose to another: half-way (..., 4, 4), rotation vector (..., 3) [rad] and translation (..., 3) [m]."""

    middle: Tensor
    turn: Tensor
    step: Tensor

    def flat(self) -> Tensor:
        """Return the parameters (..., 9) with native gradients: turn, step and pivot, the middle's translation."""
        return torch.cat([self.turn, self.step, self.middle[..., :3, 3]], -1)


def motion_between(first: Tensor, last: Tensor) -> Motion:
    """Return the motion between two poses: the shortest rotation at constant speed, linear translation.

    Differentiable in both poses, in float64.

    Args:
        first: (..., 4, 4) world to camera.
        last: (..., 4, 4).

    Raises:
        InputError: they are more than 90 degrees apart.
    """
    first, last = first.to(torch.float64), last.to(torch.float64)
    turn = _rotation_vector(last[..., :3, :3] @ first[..., :3, :3].mT)
    angle = float(turn.detach().norm(dim=-1).max()) if turn.numel() else 0.0
    if angle > _MAX_TURN:
        raise InputError(
            f"is turned by {math.degrees(angle):.0f} degrees against viewmats.", field="viewmats_rs", hint="at most 90"
        )
    rotation = torch.linalg.matrix_exp(_skew(0.5 * turn)) @ first[..., :3, :3]
    translation = 0.5 * (first[..., :3, 3:] + last[..., :3, 3:])
    bottom = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64).expand(*first.shape[:-2], 1, 4)
    middle = torch.cat([torch.cat([rotation, translation], -1), bottom], -2)
    return Motion(middle, turn, last[..., :3, 3] - first[..., :3, 3])


def _rotation_vector(R: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of rotations (..., 3, 3) below π: angle / (2 sin angle) (R - Rᵀ)."""
    twice = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    versine = 1.5 - 0.5 * R.diagonal(dim1=-2, dim2=-1).sum(-1)  # 1 - cos(angle)
    small = versine < _SMALL
    safe = torch.where(small, 1.0, versine).clamp(max=2.0 - 1e-12)
    exact = torch.arccos(1.0 - safe) / torch.sqrt(safe * (2.0 - safe))
    series = 1.0 + versine / 3.0 + 2.0 / 15.0 * versine**2 + 2.0 / 35.0 * versine**3
    return 0.5 * torch.where(small, series, exact)[..., None] * twice


def _skew(v: Tensor) -> Tensor:
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(-1)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)
