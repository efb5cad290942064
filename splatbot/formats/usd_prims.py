"""Attributes of the Gaussians of an OpenUSD file, read in a process of their own.

OpenUSD aborts its process on some damaged files. So :func:`splatbot.formats.usd.load_usd` runs this module as a
program. Its arguments are the file, the file to write and the largest memory [bytes]. The caller checks the values.
"""

from __future__ import annotations

import json
import resource
import sys
from typing import Any

import numpy as np

POSITIONS, ORIENTATIONS, SCALES, OPACITIES = "positions", "orientations", "scales", "opacities"
SH, DEGREE = "radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsDegree"

Arrays = dict[str, np.ndarray[Any, np.dtype[Any]]]


def main(source: str, target: str, memory: str) -> None:
    """Write the visible prims of Gaussians of a file, also those of instances, as arrays of numpy.

    The arrays are named after the number of the prim and the attribute; `pose` is T_stage_prim (4, 4). The text `facts`
    is JSON: `others` are the files that the layer needs, in which case nothing else is read.
    """
    resource.setrlimit(resource.RLIMIT_DATA, (int(memory), int(memory)))
    from pxr import Usd, UsdGeom

    layer = _open(source)
    others = [name for name in layer.GetCompositionAssetDependencies() if name]  # the layer itself has no name
    facts: dict[str, Any] = {"others": others, "prims": []}
    content: dict[str, Any] = {}
    if not others:
        stage = Usd.Stage.Open(layer)
        facts |= {"unit": UsdGeom.GetStageMetersPerUnit(stage), "up": UsdGeom.GetStageUpAxis(stage)}
        poses = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
        prims = stage.Traverse(Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
        for index, prim in enumerate(prim for prim in prims if _holds_gaussians(prim) and _is_visible(prim)):
            facts["prims"].append({"path": str(prim.GetPath()), "degree": int(prim.GetAttribute(DEGREE).Get())})
            pose = np.array(poses.GetLocalToWorldTransform(prim)).T  # OpenUSD multiplies rows from the left
            content |= {f"{index} {name}": values for name, values in (_attributes(prim) | {"pose": pose}).items()}
    np.savez(target, **content, facts=np.array(json.dumps(facts)))


def _open(source: str) -> Any:
    """Return the layer of a file, or end the program with the reason as its last line."""
    from pxr import Sdf, Tf

    try:
        layer = Sdf.Layer.FindOrOpen(source)
    except Tf.ErrorException as error:
        sys.exit(error.args[0].commentary.strip())
    if layer is None:
        sys.exit("OpenUSD cannot open it")
    return layer


def _holds_gaussians(prim: Any) -> bool:
    from pxr import UsdVol

    return bool(prim.IsA(UsdVol.ParticleField3DGaussianSplat))


def _is_visible(prim: Any) -> bool:
    from pxr import Usd, UsdGeom

    return bool(UsdGeom.Imageable(prim).ComputeVisibility(Usd.TimeCode.EarliestTime()) != UsdGeom.Tokens.invisible)


def _attributes(prim: Any) -> Arrays:
    """Return the values at the earliest time that the file states, in float32 or else in half precision."""
    from pxr import Usd

    time = Usd.TimeCode.EarliestTime()
    found = {
        name: prim.GetAttribute(name).Get(time) or prim.GetAttribute(f"{name}h").Get(time)
        for name in (POSITIONS, ORIENTATIONS, SCALES, OPACITIES, SH)
    }
    return {name: np.array(values, np.float32) for name, values in found.items() if values}


if __name__ == "__main__":
    main(*sys.argv[1:])
