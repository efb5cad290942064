"""`splatbot export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from splatbot.cli.paths import check_output
from splatbot.errors import InputError
from splatbot.layouts import map_file

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatbot.map_export import MapExport
    from splatbot.rasterize.meshes import MeshMethod

Format = Literal["mesh", "points", "esdf", "octomap", "grid"]


@dataclass(frozen=True)
class ExportConstants:
    """Constants of exports.

    Args:
        voxel: [m] default edge length.
    """

    voxel: float = 0.02


CONSTANTS = ExportConstants()
_FILES: dict[Format, str] = {
    "mesh": "mesh.ply",
    "points": "points.ply",
    "esdf": "esdf.npz",
    "octomap": "occupancy.bt",
    "grid": "grid.yaml, grid.pgm",
}


def export(
    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|MAP")],
    /,
    *,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    formats: Annotated[tuple[Format, ...], tyro.conf.arg(name="format", metavar="NAME ...")] = (),
    voxel: Annotated[float, tyro.conf.arg(metavar="METRES")] = CONSTANTS.voxel,
    n_sigma: float = 2.0,
    mesh_from: Literal["auto", "depth", "median", "poisson"] = "auto",
) -> int:
    """Write a map in the formats of other programs.

    The format `mesh` (mesh.ply) is the surface of the map's depth from the camera path. The format `points`
    (points.ply) has the means of the Gaussians with colours. The format `esdf` (esdf.npz) has signed distances to the
    map [m]. The format `octomap` (occupancy.bt) has the occupied and free voxels of an OctoMap. The format `grid`
    (grid.yaml, grid.pgm) is the floor plan of ROS's map_server; it needs a scene.yaml.

    Free space needs the run's recording. Without it, only occupied voxels are known. Coordinates are the map's [m]; the
    grid's are those of the robot's base.

    Examples:
        splatbot export runs/desk
        splatbot export runs/desk --format mesh --voxel 0.01 --out meshes
        splatbot export map.ply --format points esdf
        splatbot export runs/statue-trained --format mesh --mesh-from poisson

    Args:
        map: a run folder, or a map file.
        out: folder to write; by default export next to the map.
        formats: formats to write; by default all that the map allows.
        voxel: edge length of voxels; the mesh uses a quarter of it.
        n_sigma: surface of a Gaussian, in standard deviations, for distances and occupancy.
        mesh_from: depth fuses the expected depth of views (TSDF), median the depth at which half of the light is left,
            which surfels alone have. Poisson solves for the surface through rendered points and normals. Auto selects
            median for surfels and depth otherwise.
    """
    file = map_file(map)
    folder = out if out is not None else file.with_name("export")
    check_output(folder)
    if not 0.001 <= voxel <= 1.0:
        raise InputError(f"is {voxel:g} m.", field="--voxel", hint="give 0.001 to 1")

    from splatbot.atomic import replace_files
    from splatbot.cli.progress import steps
    from splatbot.map_export import MapExport
    from splatbot.results.units import megabytes

    writers: dict[str, Callable[[Path], None]] = {}
    with steps() as tell:
        tell("reading the map")
        exported = MapExport.open(file, voxel=voxel, n_sigma=n_sigma)
        for name in formats or tuple(_FILES):
            tell(f"making {_FILES[name]}")
            try:
                writers |= _writers(exported, name, None if mesh_from == "auto" else mesh_from)
            except InputError as error:
                if formats:
                    raise
                print(f"left out {_FILES[name]}: {error}")
        tell("writing")
        replace_files(folder, writers)
    for note in exported.notes:
        print(f"note: {note}")
    for written in writers:
        print(f"{folder / written}: {megabytes((folder / written).stat().st_size)}")
    return 0


def _writers(exported: MapExport, name: Format, mesh_from: MeshMethod | None) -> dict[str, Callable[[Path], None]]:
    if name == "mesh":
        return {"mesh.ply": exported.mesh(mesh_from)}
    if name == "points":
        return {"points.ply": exported.points()}
    if name == "esdf":
        return {"esdf.npz": exported.esdf()}
    if name == "octomap":
        return {"occupancy.bt": exported.octomap()}
    return exported.grid()
