"""The conventions of splat formats: axes, order of quaternions, logarithms and logits, order of harmonics.

Arrays between a format and a model have the conventions of the model, which are those of 3DGS PLY (Kerbl et al. 2023).
They hold natural logarithms of scales, logits of opacities, quaternions wxyz, and harmonics by coefficient with colours
last. Axes are x right, y down, z forward (RDF), as in COLMAP and OpenCV.

| format | axes | scale | opacity | quaternion |
|---|---|---|---|---|
| 3DGS PLY | RDF | logarithm | logit | wxyz |
| compressed PLY | RDF | logarithm | 0..1 | wxyz |
| .splat | RDF | linear | 0..1 | wxyz |
| .ksplat | RDF | linear | 0..1 | wxyz |
| SPZ | RUB (:data:`RUB`) | logarithm | 0..1 | xyzw |
| SOG | RDF | logarithm | 0..1 | wxyz |
| glTF | LUF (:data:`LUF`) | linear | 0..1 | xyzw |
| OpenUSD | RUB, or Z up (:data:`Y_UP_FROM_Z_UP`) | linear | 0..1 | xyzw |

Letters name the directions of x, y and z: Right or Left, Up or Down, Forward or Back. The axes of SPZ and PLY are those
of Niantic's converter. glTF 2.0 (section 3.4) defines +Y up, +Z forward and -X right. Arrays of quaternions of OpenUSD
are xyzw in memory, and wxyz in its text. A file of it states its unit, 1 cm by default, and whether Y or Z is up.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import FormatError, InputError
from splatbot.formats.checks import Table, check_finite, damaged, replace_degenerate
from splatbot.gaussians.harmonics import SH_C0
from splatbot.gaussians.model import OPACITY_MAX, OPACITY_MIN, GaussianModel
from splatbot.geometry import quat_multiply, rotation_to_quat

Signs = tuple[int, int, int]

_log = logging.getLogger(__name__)

RUB: Signs = (1, -1, -1)
"""Signs of x, y and z between RDF and right, up, back."""

LUF: Signs = (-1, -1, 1)
"""Signs of x, y and z between RDF and left, up, forward."""

Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Turn (4, 4) from axes right, forward, up to axes right, up, back."""

_ROUNDING = 1e-6  # of a range, above the rounding of float32
_STRETCH = 1e-4  # largest deviation of a placed pose from a rotation times a scale


class SplatArrays(NamedTuple):
    """N Gaussians in the conventions of 3DGS PLY; float32.

    Args:
        means: (N, 3) [m].
        quats: (N, 4) wxyz.
        log_scales: (N, 3), natural logarithm of standard deviations [m].
        opacity_logits: (N,).
        sh: (N, K, 3), K = (degree + 1)².
    """

    means: Table
    quats: Table
    log_scales: Table
    opacity_logits: Table
    sh: Table


def splats_of(model: GaussianModel, path: str | Path, *, max_sh_degree: int) -> SplatArrays:
    """Return the arrays of a model for a writer: unit quaternions, harmonics up to ``max_sh_degree``.

    Raises:
        InputError: the model is empty, or a value is not finite.
    """
    if not len(model):
        raise InputError("has no Gaussians.", file=path, field="model", hint="write an empty map as .ply")
    quats = model.quats.detach().numpy().astype(np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(norms == 0, (1.0, 0.0, 0.0, 0.0), quats / np.where(norms == 0, 1.0, norms))
    splats = SplatArrays(
        model.means.detach().numpy(),
        quats.astype(np.float32),
        model.log_scales.detach().numpy(),
        model.opacity_logits.detach().numpy(),
        model.sh.detach().numpy()[:, : (max_sh_degree + 1) ** 2],
    )
    for name, values in splats._asdict().items():
        if not np.isfinite(values).all():
            raise InputError("holds NaN or infinity.", file=path, field=name, hint="remove those Gaussians")
    return splats


def model_of(path: str | Path, splats: SplatArrays) -> GaussianModel:
    """Return the model of decoded arrays, with bookkeeping as of a map from another program.

    Degenerate values are replaced as in :func:`splatbot.formats.checks.replace_degenerate`.

    Raises:
        FormatError: a value is NaN or infinite.
    """
    own = SplatArrays(*(np.array(values, np.float32, order="C") for values in splats))
    replace_degenerate(path, own.opacity_logits, own.log_scales, own.quats)
    for name, values in own._asdict().items():
        rows = values.reshape(len(values), -1)
        check_finite(path, rows, [name] * rows.shape[1])
    count = len(own.means)
    return GaussianModel(
        **{name: torch.from_numpy(values) for name, values in own._asdict().items()},
        observations=torch.ones(count, dtype=torch.int32),
        anchors=torch.full((count,), -1, dtype=torch.int32),
    )


def warn_limited(path: str | Path, name: str, values: NDArray[np.floating], low: float, high: float) -> None:
    """Log a warning if values are outside of the range that a format stores, by more than float32 rounds."""
    slack = _ROUNDING * (high - low)
    count = int(((values < low - slack) | (values > high + slack)).sum())
    if count:
        _log.warning("%s: %d of %d %s were limited to %.3g..%.3g", path, count, values.size, name, low, high)


def logit(opacity: ArrayLike) -> NDArray[np.float64]:
    """Convert opacities in 0..1 to logits; 0 and 1 become the nearest opacities with a finite logit."""
    clamped = np.clip(np.asarray(opacity, np.float64), OPACITY_MIN, OPACITY_MAX)
    return np.log(clamped / (1.0 - clamped))


def sigmoid(logits: Table) -> NDArray[np.float64]:
    """Convert logits to opacities in 0..1."""
    return 0.5 * (1.0 + np.tanh(0.5 * logits.astype(np.float64)))


def linear_scales(log_scales: Table) -> Table:
    """Convert logarithms of scales (N, 3) to scales [m] within the normal range of float32."""
    return np.exp(np.clip(log_scales.astype(np.float64), -87.0, 88.0)).astype(np.float32)


def log_scales_of(path: str | Path, scales: Table) -> NDArray[np.float64]:
    """Convert scales (N, 3) [m] to their logarithms; that of 0 is -inf, which :func:`model_of` replaces.

    Raises:
        FormatError: a scale is negative.
    """
    negative = (scales < 0).any(axis=1)
    if negative.any():
        message, hint = f"row {int(np.argmax(negative))} has a negative scale.", "export it again with linear scales"
        raise FormatError(message, file=path, field="scale", hint=hint)
    with np.errstate(divide="ignore"):
        return np.log(scales.astype(np.float64))


def colors_of(sh: Table) -> NDArray[np.float64]:
    """Convert the DC term of harmonics (N, K, 3) to colours (N, 3), not clamped."""
    return sh[:, 0].astype(np.float64) * SH_C0 + 0.5


def dc_of(colors: ArrayLike) -> NDArray[np.float64]:
    """Convert colours (N, 3) to the DC term of harmonics (N, 1, 3)."""
    return ((np.asarray(colors, np.float64) - 0.5) / SH_C0)[:, None, :]


def to_channel_major(sh: Table) -> Table:
    """Return harmonics (N, K, 3) without their DC term as the columns of f_rest_* (N, 3 (K - 1))."""
    return sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * (sh.shape[1] - 1))


def from_channel_major(rest: Table) -> Table:
    """Return the columns of f_rest_* (N, 3 (K - 1)) as harmonics without their DC term (N, K - 1, 3)."""
    return rest.reshape(len(rest), 3, rest.shape[1] // 3).transpose(0, 2, 1)


def to_xyzw(quats: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return quaternions (N, 4) wxyz as xyzw."""
    return quats[:, [1, 2, 3, 0]]


def to_wxyz(quats: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return quaternions (N, 4) xyzw as wxyz."""
    return quats[:, [3, 0, 1, 2]]


def turn(splats: SplatArrays, signs: Signs) -> SplatArrays:
    """Turn or mirror splats by multiplying x, y and z by ``signs``; doing so twice changes nothing.

    The harmonic of degree l and order m is odd in y for m < 0, and in z for odd l - |m|. It is odd in x for odd m >= 0
    and for even m < 0.
    """
    x, y, z = signs
    factors = [
        (x ** ((m + (m < 0)) % 2)) * (y ** (m < 0)) * (z ** ((degree - m) % 2))
        for degree in range(round(splats.sh.shape[1] ** 0.5))
        for m in range(-degree, degree + 1)
    ]
    return splats._replace(
        means=splats.means * np.array(signs, np.float32),
        quats=splats.quats * np.array([1, y * z, x * z, x * y], np.float32),
        sh=splats.sh * np.array(factors, np.float32)[:, None],
    )


def move(splats: SplatArrays, rotation: NDArray[np.float64], shift: NDArray[np.float64], scale: float) -> SplatArrays:
    """Move splats: a point p becomes ``scale * rotation @ p + shift``, and colours turn with the Gaussians."""
    means = scale * splats.means.astype(np.float64) @ rotation.T + shift
    quats = quat_multiply(rotation_to_quat(rotation), splats.quats.astype(np.float64))
    return SplatArrays(
        means.astype(np.float32),
        quats.astype(np.float32),
        (splats.log_scales + np.log(scale)).astype(np.float32),
        splats.opacity_logits,
        rotate_harmonics(splats.sh, rotation),
    )


def place(path: str | Path, splats: SplatArrays, T: NDArray[np.float64], field: str) -> SplatArrays:
    """Move splats by a matrix (4, 4) that a file states: a rotation, a shift and one scale.

    Raises:
        FormatError: the matrix is singular, or mirrors or stretches the splats.
    """
    if np.array_equal(T, np.eye(4)):
        return splats
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    if not (np.isfinite(T).all() and scale > 0):
        raise damaged(path, field, "a pose is singular or mirrors")
    rotation = T[:3, :3] / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _STRETCH:
        hint = "apply the scale of the node before the export"
        raise FormatError("stretches the splats unevenly.", file=path, field=field, hint=hint)
    return move(splats, rotation, T[:3, 3], scale)


def rotate_harmonics(sh: Table, rotation: NDArray[np.float64]) -> Table:
    """Rotate harmonics (N, K, 3): the colour towards ``rotation @ d`` becomes the previous one towards ``d``.

    The matrix of the rotation is fitted to the values of the harmonics in fixed directions, where it is exact.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    if degree == 0:
        return sh
    directions = np.random.default_rng(0).normal(size=(8 * sh.shape[1], 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values, turned = _harmonics(directions, degree), _harmonics(directions @ rotation, degree)
    matrix = np.linalg.lstsq(values, turned, rcond=None)[0]
    return np.einsum("jk,nkc->njc", matrix, sh.astype(np.float64)).astype(np.float32)


def _harmonics(directions: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return real harmonics (S, (degree + 1)²) in unit directions (S, 3), up to a factor for each degree."""
    from scipy.special import factorial, lpmv

    longitude, z = np.arctan2(directions[:, 1], directions[:, 0]), directions[:, 2]
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            norm = np.sqrt(factorial(n - abs(m)) / factorial(n + abs(m)) * (1 if m == 0 else 2))
            wave = np.sin(-m * longitude) if m < 0 else np.cos(m * longitude)
            columns.append(norm * lpmv(abs(m), n, z) * wave)
    return np.stack(columns, axis=1)
