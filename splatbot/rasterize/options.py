"""Options of a render, and the options of gsplat that it refuses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from splatbot.errors import InputError

DEFAULT_TILE_SIZE = 16
TRANSMITTANCE_MIN = 1e-4

# Render mode: whether colours are rendered, and the kind of depth.
_MODES = {
    "RGB": (True, "none"),
    "D": (False, "accumulated"),
    "ED": (False, "expected"),
    "RGB+D": (True, "accumulated"),
    "RGB+ED": (True, "expected"),
    "MD": (False, "accumulated"),  # median depth is found afterwards; something must be blended
    "RGB+MD": (True, "none"),
}

# gsplat's options that this rasterizer does not have, with the value that has no effect.
_ABSENT: dict[str, Any] = {
    "distributed": False,
    "segmented": False,
    "with_eval3d": False,
    "global_z_order": True,
    "rays": None,
    "ftheta_coeffs": None,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "extra_signals": None,
    "extra_signals_sh_degree": None,
    "renderer_config": None,
}


@dataclass(frozen=True)
class RasterOptions:
    """Checked options; lengths in the units of :func:`splatbot.rasterize.rasterization`."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_degree: int  # -1: colours are colours
    depth: str  # none, accumulated, expected
    plane_depth: bool
    antialiased: bool
    transmittance_min: float
    packed: bool
    tile_size: int
    sparse_grad: bool
    absgrad: bool
    lenses: tuple[Any, ...] | None = None  # native, of every view. If None, plain pinholes


def parse_mode(render_mode: str) -> tuple[bool, str]:
    """Return whether colours are rendered, and the kind of depth: "none", "accumulated" or "expected".

    Raises:
        InputError: an unknown mode.
    """
    if render_mode not in _MODES:
        raise InputError(f"is {render_mode!r}.", field="render_mode", hint=f"one of {', '.join(_MODES)}")
    return _MODES[render_mode]


def harmonics_degree(render_mode: str, sh_degree: int | None) -> int:
    """Return the degree of the harmonics that the mode renders; -1 where colours are colours, or none are rendered."""
    wants_color, _ = parse_mode(render_mode)
    return sh_degree if wants_color and sh_degree is not None else -1


def check_choice(name: str, value: object, known: tuple[str, ...]) -> None:
    """Raise InputError unless the value is one of those known."""
    if value not in known:
        raise InputError(f"{value!r} is not supported.", field=name, hint=f"use {', '.join(map(repr, known))}")


def refuse_absent(absent: dict[str, Any]) -> None:
    """Refuse an option that would change the result instead of ignoring it.

    Raises:
        InputError: naming the option.
    """
    for name, value in absent.items():
        if name not in _ABSENT:
            raise InputError("is no option of rasterization().", field=name, hint="see its signature")
        nothing = _ABSENT[name]
        if value is not None and value != nothing:
            raise InputError("is not supported.", field=name, hint="leave it out")
