"""Visual meshes of arms, simplified, for pictures alone: no check uses them."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError
from splatbot.protocols import Array
from splatbot.robots.shapes import Mesh, Shape

if TYPE_CHECKING:
    import open3d as o3d

STEP = 1e-5
"""Resolution of stored corners [m]."""
MOST_TRIANGLES = 1500
"""Triangles of a part, at most."""
_CELL = 0.004  # [m] within which corners become one


def simplify(vertices: Array, faces: NDArray[np.integer], most: int) -> o3d.geometry.TriangleMesh:
    """Reduce a mesh to at most ``most`` triangles by quadric decimation (Garland and Heckbert 1997).

    Args:
        vertices: (V, 3) [m].
        faces: (T, 3) rows of vertices.
        most: triangles of the result, at most.
    """
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    mesh = mesh.merge_close_vertices(STEP).remove_degenerate_triangles()
    if len(mesh.triangles) > most:
        mesh = mesh.simplify_quadric_decimation(most)
    if len(mesh.triangles) > 2 * most:  # many loose pieces keep their triangles
        mesh = mesh.simplify_vertex_clustering(_CELL)
    return mesh.remove_unreferenced_vertices()


def visual_meshes(shapes: Iterable[Shape]) -> tuple[Mesh, ...]:
    """Return one simplified mesh for each link that has shapes."""
    by_link: dict[int, list[Array]] = {}
    for shape in shapes:
        by_link.setdefault(shape.link, []).append(shape.triangles())
    found = []
    for link, parts in sorted(by_link.items()):
        corners = np.concatenate(parts).reshape(-1, 3)
        mesh = simplify(corners, np.arange(len(corners)).reshape(-1, 3), MOST_TRIANGLES)
        found.append(Mesh(link, np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64), closed=False))
    return tuple(found)


def save_visual(meshes: Iterable[Mesh], path: Path) -> None:
    """Write the meshes of links to an NPZ file."""
    stored: dict[str, np.ndarray] = {}
    for mesh in meshes:
        stored[f"{mesh.link}"] = np.rint(mesh.vertices / STEP).astype(np.int32)
        stored[f"{mesh.link}/faces"] = mesh.faces.astype(np.uint32)
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, **stored)


def load_visual(path: Path, links: int) -> tuple[Mesh, ...]:
    """Read the meshes of links from a file of :func:`save_visual`.

    Args:
        path: the file.
        links: number of the links, with the base.

    Raises:
        FormatError: the file is damaged.
    """
    found = []
    try:
        with np.load(path, allow_pickle=False) as stored:
            for name in (name for name in stored.files if "/" not in name):
                vertices, faces = STEP * stored[name].astype(np.float64), stored[f"{name}/faces"].astype(np.int64)
                if not 0 <= int(name) < links or (faces.size and faces.max() >= len(vertices)):
                    raise ValueError(f"link {name}")
                found.append(Mesh(int(name), vertices.reshape(-1, 3), faces.reshape(-1, 3), closed=False))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FormatError(f"holds no meshes ({error}).", file=path, hint="add the robot again") from error
    return tuple(found)
