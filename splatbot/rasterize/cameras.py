"""Cameras that are no plain pinhole: orthographic, fisheye, distorted, and read line by line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.native import native
from splatbot.rasterize.shutter import Motion, RollingShutterType, motion_between, shutter_of

CameraModel = Literal["pinhole", "ortho", "fisheye"]
CAMERA_MODELS: tuple[CameraModel, ...] = ("pinhole", "ortho", "fisheye")
NO_LIMIT = 1e30


@dataclass(frozen=True)
class UnscentedTransformParameters:
    """Spread of the sigma points (Julier and Uhlmann 2004; gsplat's names and defaults).

    The points lie ``alpha * sqrt(3 + kappa)`` standard deviations from the centre; ``beta`` = 2 suits Gaussians.
    """

    alpha: float = 0.1
    beta: float = 2.0
    kappa: float = 0.0

    def sigma(self) -> tuple[float, float, float]:
        """Return the sigma points' distance [σ], their weight, and the centre's covariance weight β - α².

        Raises:
            InputError: the points would coincide, or the covariance could be negative.
        """
        values = (self.alpha, self.beta, self.kappa)
        fits = all(map(math.isfinite, values)) and self.alpha > 0 and self.kappa > -3 and self.beta >= self.alpha**2
        if not fits:
            raise InputError(f"is {self}.", field="ut_params", hint="alpha > 0, kappa > -3, beta >= alpha²")
        square = self.alpha**2 * (3.0 + self.kappa)
        return math.sqrt(square), 0.5 / square, self.beta - self.alpha**2


@dataclass(frozen=True)
class CameraSettings:
    """Camera settings of a render in addition to poses and intrinsics; see ``rasterization``."""

    model: str = "pinhole"
    with_ut: bool = False
    radial_coeffs: Tensor | None = None
    tangential_coeffs: Tensor | None = None
    thin_prism_coeffs: Tensor | None = None
    rolling_shutter: Any = None
    viewmats_rs: Tensor | None = None
    ut_params: Any = None

    @property
    def plain(self) -> bool:
        """True for a pinhole without distortion."""
        return self.model == "pinhole" and not self.with_ut

    def check(self) -> None:
        """Refuse options that do not go together.

        Raises:
            InputError: naming the option.
        """
        if self.model not in CAMERA_MODELS:
            raise InputError(
                f"{self.model!r} is not supported.", field="camera_model", hint=f"one of {', '.join(CAMERA_MODELS)}"
            )
        coefficients = {
            name: getattr(self, name) for name in ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")
        }
        needs_ut = {**coefficients, "viewmats_rs": self.viewmats_rs, "ut_params": self.ut_params}
        for name, value in needs_ut.items():
            if value is not None and not self.with_ut:
                raise InputError("needs the unscented transform.", field=name, hint="pass with_ut=True")
        for name, value in coefficients.items():
            if value is not None and (self.model == "ortho" or (self.model == "fisheye" and name != "radial_coeffs")):
                raise InputError(f"is given to a {self.model} camera.", field=name, hint="leave it out")
            if value is not None and value.requires_grad:
                raise InputError("receives no gradient.", field=name, hint=f"pass {name}.detach()")
        rolling = shutter_of(self.rolling_shutter) is not RollingShutterType.GLOBAL
        if rolling and self.viewmats_rs is None:
            raise InputError("is missing.", field="viewmats_rs", hint="give the poses (C, 4, 4) at the last line")
        if self.viewmats_rs is not None and not rolling:
            raise InputError("is of no use to a global shutter.", field="viewmats_rs", hint="give rolling_shutter")


class Cameras(NamedTuple):
    """Camera parameters as the kernels take them.

    Args:
        lenses: of each view; None for plain pinholes.
        viewmats: (..., C, 4, 4); with a rolling shutter, half-way between the first and the last line, float64.
        motion: (..., C, 9) of a rolling shutter, see ``Motion.flat``; None for a global one.
    """

    lenses: tuple[Any, ...] | None
    viewmats: Tensor
    motion: Tensor | None = None


def cameras_of(settings: CameraSettings, viewmats: Tensor, near_plane: float) -> Cameras:
    """Return the cameras of all views.

    Args:
        settings: of all views; tensors have the leading dimensions of ``viewmats``.
        viewmats: (..., C, 4, 4) world to camera.
        near_plane: [m].

    Raises:
        InputError: options do not go together, or a shape or value does not fit.
    """
    settings.check()
    if settings.plain:
        return Cameras(None, viewmats)
    views = tuple(viewmats.shape[:-2])
    if not settings.with_ut:
        return Cameras((native().Lens.affine(settings.model),) * math.prod(views), viewmats)
    params = UnscentedTransformParameters() if settings.ut_params is None else settings.ut_params
    sigma = UnscentedTransformParameters(params.alpha, params.beta, params.kappa).sigma()
    radial = _coefficients("radial_coeffs", settings.radial_coeffs, views, 4 if settings.model == "fisheye" else 6)
    tangential = _coefficients("tangential_coeffs", settings.tangential_coeffs, views, 2)
    thin_prism = _coefficients("thin_prism_coeffs", settings.thin_prism_coeffs, views, 4)
    limit = fisheye_limit if settings.model == "fisheye" else pinhole_limit
    lenses = tuple(
        native().Lens.unscented(
            settings.model, [*k, *[0.0] * (6 - len(k))], p.tolist(), s.tolist(), limit(k), near_plane, list(sigma)
        )
        for k, p, s in zip(radial, tangential, thin_prism, strict=True)
    )
    if settings.viewmats_rs is None:
        return Cameras(lenses, viewmats)
    motion = _motion(settings, viewmats)
    shutter = shutter_of(settings.rolling_shutter).value
    parts = (t.detach().reshape(-1, 3).tolist() for t in motion.flat().split(3, -1))
    rolled = tuple(lens.rolling(shutter, *of_view) for lens, *of_view in zip(lenses, *parts, strict=True))
    return Cameras(rolled, motion.middle, motion.flat())


def _motion(settings: CameraSettings, viewmats: Tensor) -> Motion:
    last = settings.viewmats_rs
    if last is None or tuple(last.shape) != tuple(viewmats.shape) or not last.isfinite().all():
        raise InputError("does not fit viewmats.", field="viewmats_rs", hint="give finite poses of the same shape")
    return motion_between(viewmats, last)


def pinhole_limit(radial: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the tangent of the angle at which OpenCV's rational distortion (k1 .. k6) stops growing, or 1e30."""
    k = np.asarray(radial, dtype=np.float64)
    above, below = np.polynomial.Polynomial([1.0, *k[:3]]), np.polynomial.Polynomial([1.0, *k[3:6]])
    s = np.polynomial.Polynomial([0.0, 1.0])  # squared tangent
    slope = above * below + 2 * s * (above.deriv() * below - above * below.deriv())
    return math.sqrt(min(_first_root(slope), _first_root(below)))


def fisheye_limit(radial: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the angle [rad] at which OpenCV's fisheye polynomial (k1 .. k4) stops growing, at most π."""
    k = np.asarray(radial, dtype=np.float64)
    slope = np.polynomial.Polynomial([1.0, *(k * np.array([3.0, 5.0, 7.0, 9.0]))])
    return min(math.sqrt(_first_root(slope)), math.pi)


def _first_root(polynomial: np.polynomial.Polynomial) -> float:
    """Return the least positive root, or 1e60 without one."""
    roots = polynomial.trim().roots() if polynomial.trim().degree() > 0 else np.array([])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots.real))) & (roots.real > 0)]
    return float(real.min()) if len(real) else NO_LIMIT**2


def _coefficients(name: str, given: Tensor | None, views: tuple[int, ...], columns: int) -> NDArray[np.float64]:
    """Return the rows (V, columns) of all views."""
    if given is None:
        return np.zeros((math.prod(views), columns))
    if tuple(given.shape) != (*views, columns):
        raise InputError(f"is {tuple(given.shape)}, expected {(*views, columns)}.", field=name)
    values = given.detach().double().reshape(-1, columns).numpy()
    if not np.isfinite(values).all():
        raise InputError("is not finite.", field=name)
    return values
