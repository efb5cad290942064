"""Meshes that the makers of arms publish, from packages that ship them; splatbot ships spheres that contain them.

The sources are in :mod:`splatbot.robots.sources`. Collada files need pycollada. All packages are in the extra ``dev``.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.protocols import Array
from splatbot.robots.shapes import Mesh, Shape

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class Source:
    """Where the meshes of a robot come from.

    Args:
        package: distribution on PyPI.
        folder: folder of the meshes among its files.
        origin: publication that the package copies.
        licence: SPDX identifier of that publication.
        parts: files of each part, visual and collision meshes, relative to the folder.
        share: share of the slack that the fit of a part gets; 1 for other parts.
    """

    package: str
    folder: str
    origin: str
    licence: str
    parts: dict[str, tuple[str, ...]]
    share: dict[str, float] = field(default_factory=dict)

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

    def title(self) -> str:
        """Return package, version, origin and licence."""
        return f"{self.package} {self.version()} ({self.origin}, {self.licence})"

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


_PART = 0.25  # size of a part relative to its mesh, above which it is a solid of its own
_CRACKS = 0.002  # share of the edges that may have one face only in a closed mesh
_CHUNK = 1000  # triangles that are compared with a hull at once
_MOST_BYTES = 256 << 20  # of a mesh file; it bounds memory


def read_shapes(path: Path, link: int, scale: ArrayLike = 1.0) -> list[Mesh]:
    """Read a mesh file.

    A mesh that is closed, or convex but for rounding (then its hull is added), has an inside; others are surfaces.

    Args:
        path: STL, OBJ, PLY or Collada file.
        link: index of its link.
        scale: factor of the mesh, a number or (3,). The unit of a Collada file counts, too.

    Raises:
        InputError: the file cannot be read.
    """
    import trimesh

    if path.stat().st_size > _MOST_BYTES:
        size = f"has {path.stat().st_size >> 20} MB."
        raise InputError(size, field=path.name, hint=f"simplify the mesh to {_MOST_BYTES >> 20} MB or less")
    try:
        scene = trimesh.load_scene(path, process=False)
        pieces = scene.dump()
    except (ImportError, ValueError, OSError) as error:
        raise InputError(
            f"cannot be read ({error}).", field=path.name, hint="pip install pycollada for .dae"
        ) from error
    meshes = [piece for piece in pieces if isinstance(piece, trimesh.Trimesh)]
    loaded = trimesh.util.concatenate(meshes)
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError("holds no triangles.", field=path.name, hint="give an STL, OBJ or Collada file")
    # A Collada file names its unit; other formats have none, and URDF takes metres.
    unit = trimesh.units.unit_conversion(scene.units, "meters") if scene.units and path.suffix == ".dae" else 1.0
    factors = unit * np.broadcast_to(np.asarray(scale, dtype=np.float64), 3)
    around = loaded.faces if factors.prod() > 0 else loaded.faces[:, ::-1]  # a mirror turns faces inside out
    return as_shapes(np.asarray(loaded.vertices) * factors, np.asarray(around, dtype=np.int64), link)


def as_shapes(vertices: Array, faces: NDArray[np.int64], link: int) -> list[Mesh]:
    """Return the connected parts of a triangle mesh as shapes.

    A part that is closed has an inside. The hull of a part that is convex but for rounding is added, as that of a tube
    without lids. All other parts are one surface.

    Args:
        vertices: (V, 3) [m, link frame].
        faces: (T, 3) rows of the vertices.
        link: index of the link.
    """
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=True)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if _is_closed(mesh):
        return [_shape(mesh, link)]
    found: list[Mesh] = []
    surfaces: list[trimesh.Trimesh] = []
    for part in mesh.split(only_watertight=False):
        large = part.extents.max() > _PART * mesh.extents.max()
        if large and _is_closed(part):
            found.append(_shape(part, link))
            continue
        surfaces.append(part)
        if large and _is_nearly_hull(part, hull := part.convex_hull):
            found.append(_shape(hull, link))
    if surfaces:
        joined = trimesh.util.concatenate(surfaces)
        assert isinstance(joined, trimesh.Trimesh)
        found.append(_shape(joined, link, closed=False))
    return found


def _shape(mesh: trimesh.Trimesh, link: int, closed: bool = True) -> Mesh:
    return Mesh(link, np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64), closed)


def _is_closed(mesh: trimesh.Trimesh) -> bool:
    """Return whether every edge has two faces, but for a few at cracks: rays of several directions outvote those."""
    if mesh.is_watertight:
        return True
    _, faces = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    return float((faces == 1).mean()) <= _CRACKS


def _is_nearly_hull(mesh: trimesh.Trimesh, hull: trimesh.Trimesh) -> bool:
    """Return whether every face lies within 1 % of the mesh's size of its hull's surface."""
    planes = np.c_[hull.face_normals, -np.einsum("ij,ij->i", hull.face_normals, hull.triangles_center)]
    centers, allowed = mesh.triangles_center, 0.01 * float(mesh.extents.max())
    return all(
        -(centers[k : k + _CHUNK] @ planes[:, :3].T + planes[:, 3]).max(axis=1).min() <= allowed
        for k in range(0, len(centers), _CHUNK)
    )


ReportProgress = Callable[[str], None]
