"""A scene from a map and its `scene.yaml`, which gives the base pose, gravity and support plane."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from splatbot.errors import InputError
from splatbot.geometry import inverse
from splatbot.protocols import Array
from splatbot.sim.solids import rpy_of
from splatbot.workspace import Workspace, find_workspace

_G = 9.81  # [m/s²]
_MAP = "map.ply"


def placed_scene(place: Path, *, T_world_base: Array | None = None) -> dict[str, Any]:
    """Return the values for :func:`splatbot.sim.scene.make_scene`: the map in the frame of the robot's base.

    Args:
        place: a run's folder, or a map file. Without a `scene.yaml` next to a map
            file, its own frame is that of the base.
        T_world_base: (4, 4) pose of the base [m]. If None, it is that of the `scene.yaml`.

    Raises:
        InputError: the folder has no map, or the run has no base pose.
        FormatError: the `scene.yaml` is damaged.
    """
    file = place / _MAP if place.is_dir() else place
    if place.is_dir() and not file.is_file():
        raise InputError(f"holds no {_MAP}.", file=place, field="--map", hint="give a map file, or the folder of a run")
    known = find_workspace(file)
    values: dict[str, Any] = {"name": place.resolve().stem, "map": {"file": str(file.resolve())}}
    placed = T_world_base if known is None or T_world_base is not None else known.T_world_base
    if placed is None:
        if place.is_dir():
            hint = "give --base, or write a scene.yaml: splatbot info RUN --fit-plane estimates one"
            raise InputError("does not define the base pose.", field="T_world_base", file=place, hint=hint)
        return values
    return values | _placed(values["map"], known or Workspace(), inverse(placed))


def _placed(clutter: dict[str, Any], known: Workspace, T_base_world: Array) -> dict[str, Any]:
    R, t = T_base_world[:3, :3], T_base_world[:3, 3]
    clutter |= {"at": t.tolist(), "rpy": rpy_of(R)}
    if known.support_plane is not None:  # n · p + d = 0, in the base's frame
        normal = R @ known.support_plane[:3]
        clutter["support"] = [*normal.tolist(), float(known.support_plane[3] - normal @ t)]
    gravity = {} if known.gravity is None else {"gravity": (_G * (R @ known.gravity)).tolist()}
    return {"map": clutter, **gravity}
