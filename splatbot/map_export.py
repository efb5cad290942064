"""A map in the formats of other programs: mesh, points, distance grid, OctoMap and floor plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import write_bytes, write_text
from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, UnknownSpace, esdf, find_unknown
from splatbot.errors import InputError, SplatbotError
from splatbot.formats.octomap import save_octomap
from splatbot.gaussians import GaussianModel
from splatbot.geometry import transform_points
from splatbot.logs import open_log
from splatbot.rasterize.meshes import MeshMethod, map_mesh
from splatbot.results.folder import RunFolder
from splatbot.results.views import subsampled_views
from splatbot.segmentation.objects import solid_rows
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace, find_workspace

Array = NDArray[np.float64]
Writer = Callable[[Path], None]


@dataclass(frozen=True)
class MapExportConstants:
    """Constants of exported maps.

    Args:
        trimmed: [%] Gaussians outside of the exported box on each side, so that strays do not enlarge it.
        max_voxels: largest number of voxels of a grid.
        chunk: number of voxels that are queried at once.
        mesh_views: largest number of views that are fused into the mesh.
        mesh_size: [px] width and height of these views.
        mesh_focal: focal length relative to the width.
        band: [m] heights above the support in which the floor plan sees obstacles.
    """

    trimmed: float = 0.5
    max_voxels: int = 12_000_000
    chunk: int = 500_000
    mesh_views: int = 60
    mesh_size: tuple[int, int] = (640, 480)
    mesh_focal: float = 0.8
    band: tuple[float, float] = (0.03, 0.8)


CONSTANTS = MapExportConstants()


@dataclass
class MapExport:
    """Exports of one map; each method returns a function that writes the file at a path.

    Args:
        file: the map file.
        model: the map.
        voxel: edge length [m].
        n_sigma: surface of a Gaussian, in standard deviations.
        notes: parts that could not be used, with reasons.
    """

    file: Path
    model: GaussianModel
    voxel: float
    n_sigma: float
    notes: list[str] = field(default_factory=list)

    @classmethod
    def open(cls, file: Path, *, voxel: float, n_sigma: float) -> MapExport:
        """Load a map.

        Raises:
            FormatError: the file is damaged.
            InputError: the map is empty.
        """
        model = GaussianModel.load(file)
        if not solid_rows(model).any():
            raise InputError("has no observed surface.", file=file, field="map", hint="map a log first")
        return cls(file, model, voxel, n_sigma)

    def points(self) -> Writer:
        """Export the means of the observed Gaussians with colours as a PLY point cloud."""
        import open3d as o3d

        rows = np.flatnonzero(solid_rows(self.model))
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self.model.means.double().numpy()[rows]))
        cloud.colors = o3d.utility.Vector3dVector(self.model.colors.double().numpy()[rows])
        return lambda path: _written(o3d.io.write_point_cloud(path, cloud), path)

    def mesh(self, method: MeshMethod | None = None) -> Writer:
        """Export the surface that the map shows along the camera path, see :func:`splatbot.rasterize.meshes.map_mesh`.

        Raises:
            InputError: the camera path is not known, it shows no surface, or the method does not fit the map.
        """
        import open3d as o3d

        path = self.file.with_name("trajectory.tum")
        if not path.is_file():
            raise InputError("is missing.", file=path, field="mesh", hint="export the folder of a run")
        poses = Trajectory.load(path).T_world_camera
        width, height = CONSTANTS.mesh_size
        f = CONSTANTS.mesh_focal * width
        camera = Camera(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
        views = [(camera, T) for T in poses[:: max(1, -(-len(poses) // CONSTANTS.mesh_views))]]
        try:
            mesh = map_mesh(self.model, views, self.voxel / 4, method)
        except InputError as error:
            error.file = str(self.file)
            raise
        return lambda place: _written(o3d.io.write_triangle_mesh(place, mesh), place)

    def esdf(self) -> Writer:
        """Export signed distances [m] on a grid: distance_m (X, Y, Z), origin_m (3,) of the first centre, voxel_m."""
        origin, shape = self._box()
        grid = esdf(self._field, np.stack([origin, origin + self.voxel * np.array(shape)]), self.voxel, cut=1.0)

        def write(path: Path) -> None:
            with path.open("wb") as file:
                np.savez_compressed(
                    file, distance_m=grid.distance, origin_m=origin + self.voxel / 2, voxel_m=self.voxel
                )

        return write

    def octomap(self) -> Writer:
        """Export occupied and free voxels as an OctoMap."""
        keys, occupied = self._known_voxels()
        return lambda path: save_octomap(path, keys, occupied, self.voxel)

    def grid(self) -> dict[str, Writer]:
        """Export the floor plan of ROS's map_server in the frame of the robot's base.

        Raises:
            InputError: the base is not known.
        """
        place = find_workspace(self.file)
        if place is None or place.T_world_base is None:
            hint = "write a scene.yaml: splatbot info RUN --fit-plane"
            raise InputError("needs a base.", file=self.file, field="grid", hint=hint)
        plan, origin = self._floor_plan(place)
        image = np.where(plan == 1, 0, np.where(plan == 0, 254, 205)).astype(np.uint8)
        rows = np.flipud(image.T)  # image rows run down, y runs up
        header = f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode()
        x, y = origin
        text = (
            f"image: grid.pgm\nmode: trinary\nresolution: {self.voxel:g}\norigin: [{x:.6g}, {y:.6g}, 0.0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )
        return {"grid.pgm": write_bytes(header + rows.tobytes()), "grid.yaml": write_text(text)}

    def _floor_plan(self, place: Workspace) -> tuple[NDArray[np.int8], tuple[float, float]]:
        """Return 1 occupied, 0 free, -1 unknown for each cell (X, Y), and the origin (x, y) [m]."""
        T = place.T_world_base
        assert T is not None
        local = transform_points(np.linalg.inv(T), self.model.means.double().numpy()[solid_rows(self.model)])
        low, high = np.percentile(local, [CONSTANTS.trimmed, 100 - CONSTANTS.trimmed], axis=0)
        cells = np.ceil((high[:2] - low[:2]) / self.voxel).astype(int) + 1
        heights = np.arange(CONSTANTS.band[0] + self.voxel / 2, CONSTANTS.band[1], self.voxel)
        self._check_size((int(cells[0]), int(cells[1]), len(heights)))
        numbers = np.moveaxis(np.indices(tuple(cells.tolist())), 0, -1).reshape(-1, 2)
        xy = low[:2] + (numbers + 0.5) * self.voxel
        occupied, free = np.zeros(len(xy), np.bool_), np.zeros(len(xy), np.bool_)
        for z in heights:
            points = transform_points(T, np.c_[xy, np.full(len(xy), z)])
            occupied |= self._occupied(points)
            free |= ~self._unknown.at(points) if self._unknown is not None else False
        plan = np.where(occupied, 1, np.where(free, 0, -1)).astype(np.int8).reshape(*cells)
        return plan, (float(low[0]), float(low[1]))

    def _known_voxels(self) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        origin, shape = self._box()
        first = np.round(origin / self.voxel).astype(np.int64)
        keys = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3) + first
        centers = np.asarray((keys + 0.5) * self.voxel, dtype=np.float64)
        occupied = self._occupied(centers)
        free = np.zeros(len(keys), np.bool_) if self._unknown is None else ~self._unknown.at(centers)
        known = occupied | free
        return keys[known], occupied[known]

    def _occupied(self, centers: Array) -> NDArray[np.bool_]:
        """Return whether the ball in each voxel at centers (P, 3) touches the map."""
        found = [
            self._field.in_collision(np.c_[part, np.full(len(part), self.voxel / 2)])
            for part in np.array_split(centers, max(1, -(-len(centers) // CONSTANTS.chunk)))
        ]
        return np.concatenate(found)

    @cached_property
    def _field(self) -> GaussianCollisionField:
        return GaussianCollisionField(self.model, self.n_sigma)

    @cached_property
    def _unknown(self) -> UnknownSpace | None:
        """Unknown space of the box, or None without the recording of the map."""
        origin, shape = self._box()
        run = RunFolder(self.file.parent)
        try:
            source = run.load_metrics().get("log", {})
            log = open_log(str(source["uri"]), camera=source.get("camera"))
            views = subsampled_views(run, log)
        except (SplatbotError, KeyError) as error:
            self.notes.append(f"only occupied space is known, because the recording cannot be read: {error}")
            return None
        box = np.stack([origin, origin + self.voxel * np.array(shape)])
        return find_unknown(box, self.voxel, views)

    def _box(self) -> tuple[Array, tuple[int, int, int]]:
        """Return the corner (3,) [m], a multiple of the voxel, and the number of voxels along x, y, z."""
        means = self.model.means.double().numpy()[solid_rows(self.model)]
        low, high = np.percentile(means, [CONSTANTS.trimmed, 100 - CONSTANTS.trimmed], axis=0)
        first = np.floor(low / self.voxel) - 1
        x, y, z = (np.ceil(high / self.voxel) + 1 - first).astype(int).tolist()
        self._check_size((x, y, z))
        return first * self.voxel, (x, y, z)

    def _check_size(self, shape: tuple[int, int, int]) -> None:
        count = int(np.prod(np.array(shape, dtype=np.float64)))
        if count > CONSTANTS.max_voxels:
            larger = self.voxel * (count / CONSTANTS.max_voxels) ** (1 / 3)
            hint = f"give --voxel {1.05 * larger:.3f} or more"
            raise InputError(f"makes {count:,} voxels, at most {CONSTANTS.max_voxels:,}.", field="--voxel", hint=hint)


def _written(done: bool, path: Path) -> None:
    if not done:
        import errno

        raise OSError(errno.ENOSPC, "could not be written", str(path))
