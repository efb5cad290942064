"""OpenUSD files with Gaussians: the schema ParticleField3DGaussianSplat of OpenUSD 26.03 and later, by Pixar's library.

Source: the chapter usdVol of openusd.org, and its file `schema.usda`. A prim has `positions`, `orientations`, linear
`scales`, `opacities` (0..1) and `radiance:sphericalHarmonicsCoefficients`, by Gaussian, coefficient and colour. Axes of
written files are right, up, back, and their unit is the metre. Other units, and files with Z up, are converted.
"""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.checksums import check_file
from splatbot.errors import FormatError, InputError
from splatbot.formats import usd_prims
from splatbot.formats.checks import MAX_EXPANSION, Table, check_count, check_expansion, damaged
from splatbot.formats.conventions import (
    RUB,
    Y_UP_FROM_Z_UP,
    SplatArrays,
    colors_of,
    linear_scales,
    logit,
    model_of,
    place,
    sigmoid,
    splats_of,
    to_wxyz,
    to_xyzw,
    turn,
)
from splatbot.formats.usd_prims import DEGREE, OPACITIES, ORIENTATIONS, POSITIONS, SCALES, SH
from splatbot.gaussians.model import GaussianModel

MAX_SH_DEGREE = 3

_TYPE = "ParticleField3DGaussianSplat"
_MAX_READ_DEGREE = 4
_MEMORY = 2**30  # [bytes] of OpenUSD and its libraries, without the content of a file
_ONE_THREAD = {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1"}  # each thread counts as memory
_SECONDS, _BYTES_PER_SECOND = 60.0, 1e6  # for OpenUSD to read a file
_REACH = 3.0  # [standard deviations] of the extent around a mean


def load_usd(path: str | Path) -> GaussianModel:
    """Read all visible prims of Gaussians of a .usd, .usda, .usdc or .usdz file at their poses, at the earliest time.

    Attributes that the file leaves out have the values of the schema: no rotation, scales of 1, opacity 1, grey of
    degree 0.

    Raises:
        FormatError: the file is missing or damaged, needs other files, or holds no Gaussians.
        InputError: the extra `usd` is not installed.
    """
    check_file(path)
    _check_installed(path)
    facts, arrays = _read_prims(path)
    if facts["others"]:
        hint = "write it as one layer (usdcat --flatten)"
        raise FormatError(f"needs the file {facts['others'][0]:.80}.", file=path, field="references", hint=hint)
    if not facts["prims"]:
        hint = "give a file of Gaussian splats; meshes and points hold no Gaussians"
        raise FormatError(f"has no visible prim {_TYPE}.", file=path, field=_TYPE, hint=hint)
    T_world_stage = np.diag([facts["unit"]] * 3 + [1.0])
    if facts["up"] == "Z":
        T_world_stage = Y_UP_FROM_Z_UP @ T_world_stage
    degrees = [_degree(path, prim, attributes) for prim, attributes in zip(facts["prims"], arrays, strict=True)]
    counts = [_count(path, prim["path"], attributes) for prim, attributes in zip(facts["prims"], arrays, strict=True)]
    check_count(path, sum(counts), POSITIONS)
    decoded = 4 * (11 + 3 * (max(degrees) + 1) ** 2) * sum(counts)
    check_expansion(path, decoded, Path(path).stat().st_size, POSITIONS)
    models = []
    for prim, attributes, degree in zip(facts["prims"], arrays, degrees, strict=True):
        splats = _splats(path, prim["path"], degree, attributes)
        splats = place(path, splats, T_world_stage @ attributes["pose"], prim["path"])
        models.append(model_of(path, turn(splats, RUB)))
    return models[0] if len(models) == 1 else GaussianModel.concatenate(models)


def save_usd(model: GaussianModel, path: str | Path) -> None:
    """Write a .usd, .usda, .usdc or .usdz file with one prim of Gaussians; harmonics up to degree 3.

    Means and harmonics are stored bit for bit. Scales, opacities (0..1) and unit quaternions keep float32 precision.

    Raises:
        InputError: the model is empty, a value is not finite, or the extra `usd` is not installed.
    """
    splats = turn(splats_of(model, path, max_sh_degree=MAX_SH_DEGREE), RUB)
    _check_installed(path)
    from pxr import Tf, UsdUtils

    with TemporaryDirectory() as folder:
        target = Path(folder) / f"gaussians{Path(path).suffix.lower()}"
        content = target.with_suffix(".usdc") if target.suffix == ".usdz" else target
        try:
            done = _layer(splats).Export(str(content))
            if content != target:
                done = done and UsdUtils.CreateNewUsdzPackage(str(content), str(target))
        except Tf.ErrorException as error:
            raise OSError(errno.EIO, "OpenUSD could not write the file", folder) from error
        if not done:
            raise OSError(errno.EIO, "OpenUSD could not write the file", folder)
        with atomic_write(path) as file, target.open("rb") as source:
            shutil.copyfileobj(source, file)


def _check_installed(path: str | Path) -> None:
    try:
        from pxr.UsdVol import ParticleField3DGaussianSplat  # noqa: F401
    except ImportError as error:
        hint = "pip install 'splatbot[usd]'"
        raise InputError("needs the package usd-core 26.3 or later.", file=path, field="format", hint=hint) from error


def _layer(splats: SplatArrays) -> Any:
    """Return a layer with Gaussians whose axes are those of the file."""
    from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt

    layer = Sdf.Layer.CreateAnonymous(".usdc")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Gaussians")
    stage.SetDefaultPrim(field.GetPrim())

    def vectors(values: np.ndarray[Any, np.dtype[Any]]) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))

    scales = linear_scales(splats.log_scales)
    reach = _REACH * scales.max(axis=1, keepdims=True)
    field.CreateExtentAttr(vectors(np.stack([(splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)])))
    field.CreatePositionsAttr(vectors(splats.means))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(to_xyzw(splats.quats), np.float32)))
    field.CreateScalesAttr(vectors(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(sigmoid(splats.opacity_logits).astype(np.float32)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(round(splats.sh.shape[1] ** 0.5) - 1)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(splats.sh.reshape(-1, 3)))
    field.CreateDisplayColorPrimvar("vertex").Set(vectors(np.clip(colors_of(splats.sh), 0.0, 1.0)))
    return layer


def _read_prims(path: str | Path) -> tuple[dict[str, Any], list[dict[str, NDArray[Any]]]]:
    """Return the facts of :mod:`splatbot.formats.usd_prims`, which another process reads, and the arrays by prim."""
    try:
        with Path(path).open("rb") as file:
            suffix = ".usdz" if file.read(2) == b"PK" else ".usd"
            size = os.fstat(file.fileno()).st_size
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint="give a map file") from error
    with TemporaryDirectory() as folder:
        link, target = Path(folder) / f"map{suffix}", Path(folder) / "prims.npz"
        link.symlink_to(Path(path).resolve())  # OpenUSD chooses the format by the suffix
        memory, seconds = _MEMORY + MAX_EXPANSION * size, _SECONDS + size / _BYTES_PER_SECOND
        words = [sys.executable, "-P", "-m", usd_prims.__name__, str(link), str(target), str(memory)]
        environment = os.environ | _ONE_THREAD | {"TMPDIR": folder}  # for the reports of OpenUSD on its own end
        try:
            done = subprocess.run(
                words, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds
            )
        except subprocess.TimeoutExpired as error:
            raise damaged(path, "prims", f"OpenUSD does not read it in {error.timeout:.0f} s") from error
        if done.returncode:
            raise damaged(path, "prims", _reason(done).replace(str(link), Path(path).name))
        with np.load(target) as content:
            facts: dict[str, Any] = json.loads(str(content["facts"]))
            arrays: list[dict[str, NDArray[Any]]] = [{} for _ in facts["prims"]]
            for key in content.files:
                index, _, name = key.partition(" ")
                if name:
                    arrays[int(index)][name] = content[key]
    return facts, arrays


def _reason(done: subprocess.CompletedProcess[bytes]) -> str:
    """Return the last line of a process that failed, or the signal that ended it."""
    if done.returncode < 0:
        return f"OpenUSD ends with {signal.Signals(-done.returncode).name}"
    return done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2].strip()


def _degree(path: str | Path, prim: dict[str, Any], attributes: dict[str, NDArray[Any]]) -> int:
    """Return the degree of the harmonics of a prim; absent ones have degree 0."""
    degree = int(prim["degree"])
    if not 0 <= degree <= _MAX_READ_DEGREE:
        hint = f"export the map with a degree of at most {_MAX_READ_DEGREE}"
        raise FormatError(f"is {degree}.", file=path, field=f"{prim['path']}.{DEGREE}", hint=hint)
    return degree if SH in attributes else 0


def _count(path: str | Path, prim: str, attributes: dict[str, NDArray[Any]]) -> int:
    """Return the number of Gaussians of a prim."""
    positions = attributes.get(POSITIONS, np.zeros((0, 3)))
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise damaged(path, f"{prim}.{POSITIONS}", "is no array of points")
    check_count(path, len(positions), f"{prim}.{POSITIONS}")
    return len(positions)


def _splats(path: str | Path, prim: str, degree: int, attributes: dict[str, NDArray[Any]]) -> SplatArrays:
    """Return the Gaussians of a prim in its axes."""
    count, terms = len(attributes[POSITIONS]), (degree + 1) ** 2

    def values(name: str, default: float | tuple[float, ...], *shape: int) -> Table:
        """Return an attribute of this shape, or the default; values beyond it have no meaning in the schema."""
        if name not in attributes:
            return np.full(shape, default, np.float32)
        found, size = attributes[name].ravel(), math.prod(shape)
        if len(found) < size:
            raise damaged(path, f"{prim}.{name}", f"{len(found):,} of {size:,} numbers")
        return found[:size].reshape(shape)

    scales = values(SCALES, 1.0, count, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(scales)
    return SplatArrays(
        values(POSITIONS, 0.0, count, 3),
        to_wxyz(values(ORIENTATIONS, (0.0, 0.0, 0.0, 1.0), count, 4)).astype(np.float32),
        log_scales,
        logit(values(OPACITIES, 1.0, count)).astype(np.float32),
        values(SH, 0.0, count, terms, 3),
    )
