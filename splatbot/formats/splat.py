"""The `.splat` format of antimatter15/splat: rows of 32 bytes without a header.

A row has the mean (3 float32), the standard deviations (3 float32, linear), colour and opacity (4 bytes, 0..255) and
the quaternion wxyz (4 bytes, component = (byte - 128) / 128). Source: `convert.py` of github.com/antimatter15/splat.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbot.atomic import atomic_write
from splatbot.formats.checks import check_count, damaged, read_bytes
from splatbot.formats.conventions import (
    SplatArrays,
    colors_of,
    dc_of,
    linear_scales,
    log_scales_of,
    logit,
    model_of,
    sigmoid,
    splats_of,
    warn_limited,
)
from splatbot.formats.quantize import to_steps
from splatbot.gaussians.model import GaussianModel

MAX_SH_DEGREE = 0

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def load_splat(path: str | Path) -> GaussianModel:
    """Read a .splat file.

    Raises:
        FormatError: the file is missing or truncated, a scale is negative, or a value is NaN or infinite.
    """
    data = read_bytes(path)
    check_count(path, -(-len(data) // _ROW.itemsize), "rows")
    if len(data) % _ROW.itemsize:
        raise damaged(path, "rows", f"{len(data)} bytes are no multiple of {_ROW.itemsize}")
    rows = np.frombuffer(data, _ROW)
    quats = (rows["rotation"].astype(np.float64) - 128.0) / 128.0
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    rgba = rows["rgba"] / 255.0
    log_scales = log_scales_of(path, rows["scale"])
    arrays = (rows["mean"], quats / np.where(norms > 0, norms, 1.0), log_scales, logit(rgba[:, 3]), dc_of(rgba[:, :3]))
    return model_of(path, SplatArrays(*(values.astype(np.float32) for values in arrays)))


def save_splat(model: GaussianModel, path: str | Path) -> None:
    """Write a .splat file; means are stored bit for bit, harmonics beyond DC are dropped.

    Scales keep float32 precision. Colours are limited to 0..1. Errors are at most 1/510 for colours and opacities, and
    1/256 for components of quaternions, or 1/128 next to 1.

    Raises:
        InputError: the model is empty, or a value is not finite.
    """
    splats = splats_of(model, path, max_sh_degree=MAX_SH_DEGREE)
    colors = colors_of(splats.sh)
    warn_limited(path, "colours", colors, 0.0, 1.0)
    rows = np.empty(len(splats.means), _ROW)
    rows["mean"] = splats.means
    rows["scale"] = linear_scales(splats.log_scales)
    rows["rgba"][:, :3] = to_steps(colors, 0.0, 1.0, 255)
    rows["rgba"][:, 3] = to_steps(sigmoid(splats.opacity_logits), 0.0, 1.0, 255)
    rows["rotation"] = to_steps(splats.quats, -1.0, 127.0 / 128.0, 255)
    with atomic_write(path) as file:
        file.write(rows.tobytes())
