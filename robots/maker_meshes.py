"""Meshes that the makers of arms publish, from packages that ship them; splatbot ships spheres that contain them.

The package example-robot-data holds Franka's franka_description (Apache-2.0). Collada files need pycollada. Both are in
the extra ``dev``.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from splatbot.errors import InputError
from splatbot.robots.shapes import Mesh, Shape


@dataclass(frozen=True)
class Source:
    """Where the meshes of a robot come from.

    Args:
        package: distribution on PyPI.
        folder: folder of the meshes among its files.
        origin: publication that the package copies.
        licence: SPDX identifier of that publication.
        parts: files of each part, visual and collision meshes, relative to the folder.
    """

    package: str
    folder: str
    origin: str
    licence: str
    parts: dict[str, tuple[str, ...]]

    def path(self, file: str) -> Path:
        """Return the path of an installed file.

        Raises:
            InputError: the package or the file is not installed.
        """
        hint = f"pip install {self.package} pycollada"
        try:
            files = importlib.metadata.files(self.package) or []
        except importlib.metadata.PackageNotFoundError as error:
            raise InputError("is not installed.", field=self.package, hint=hint) from error
        ending = f"{self.folder}/{file}"
        found = next((f for f in files if f.as_posix().endswith(ending)), None)
        if found is None:
            raise InputError(f"has no file {ending}.", field=self.package, hint=hint)
        return Path(str(found.locate()))

    def version(self) -> str:
        """Return the installed version of the package."""
        return importlib.metadata.version(self.package)

    def digest(self) -> str:
        """Return a SHA-256 digest of all files."""
        text = hashlib.sha256()
        for files in self.parts.values():
            for file in files:
                text.update(self.path(file).read_bytes())
        return text.hexdigest()

    def shapes(self, part: str, link: int = 0) -> list[Shape]:
        """Read the meshes of a part, and their closed convex hulls where collision meshes are hulls.

        Raises:
            InputError: a file is missing, or pycollada is.
        """
        return [shape for file in self.parts[part] for shape in read_shapes(self.path(file), link)]


def read_shapes(path: Path, link: int, scale: float = 1.0) -> list[Shape]:
    """Read a mesh file [m].

    A mesh that is closed, or convex but for rounding (then its hull is added), has an inside; others are surfaces.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        pieces = trimesh.load_scene(path, process=False).dump()
    except (ImportError, ValueError, OSError) as error:
        raise InputError(
            f"cannot be read ({error}).", field=path.name, hint="pip install pycollada for .dae"
        ) from error
    meshes = [piece for piece in pieces if isinstance(piece, trimesh.Trimesh)]
    loaded = trimesh.util.concatenate(meshes)
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError("holds no triangles.", field=path.name, hint="give an STL, OBJ or Collada file")
    mesh = trimesh.Trimesh(np.asarray(loaded.vertices) * scale, loaded.faces, process=True)
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    if mesh.is_watertight:
        return [Mesh(link, vertices, faces)]
    hull = mesh.convex_hull
    found: list[Shape] = [Mesh(link, vertices, faces, closed=False)]
    if _is_nearly_hull(mesh, hull):
        found.append(Mesh(link, np.asarray(hull.vertices), np.asarray(hull.faces, dtype=np.int64)))
    return found


def _is_nearly_hull(mesh: trimesh.Trimesh, hull: trimesh.Trimesh) -> bool:
    """Return whether every face lies within 1 % of the mesh's size of its hull's surface."""
    planes = np.c_[hull.face_normals, -np.einsum("ij,ij->i", hull.face_normals, hull.triangles_center)]
    inside = -(mesh.triangles_center @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    return bool(inside.max() <= 0.01 * float(mesh.extents.max()))


_LINKS = tuple(f"link{k}" for k in range(8))
SOURCES = {
    "panda": Source(
        "example-robot-data",
        "panda_description/meshes",
        "franka_description by Franka Robotics",
        "Apache-2.0",
        {part: (f"visual/{part}.dae", f"collision/{part}.stl") for part in (*_LINKS, "hand", "finger")},
    ),
}

ReportProgress = Callable[[str], None]
