"""Exports of a map: each is read by another library and compared with the map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import transform_points
from splatbot.map_export import MapExport
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.unit.formats.test_octomap import read_bt
from tests.unit.test_workspace import _table

VOXEL = 0.05


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[MapExport, GaussianModel, np.ndarray]:
    """The export of a table with objects on it, seen from eight poses, and T_world_table."""
    folder = tmp_path_factory.mktemp("run")
    model, T = _table()
    model.save(folder / "map.ply")
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.1, 0.1, 8)
    Trajectory(np.arange(8.0), poses).save(folder / "trajectory.tum")
    Workspace(T_world_base=T).save(folder / "scene.yaml")
    return MapExport.open(folder / "map.ply", voxel=VOXEL, n_sigma=2.0), model, T


def test_points_and_mesh_open_in_open3d(exported: tuple[MapExport, GaussianModel, np.ndarray], tmp_path: Path) -> None:
    export, model, T = exported
    export.points()(tmp_path / "points.ply")
    cloud = o3d.io.read_point_cloud(tmp_path / "points.ply")
    np.testing.assert_allclose(np.asarray(cloud.points), model.means.numpy(), atol=1e-6)
    export.mesh()(tmp_path / "mesh.ply")
    mesh = o3d.io.read_triangle_mesh(tmp_path / "mesh.ply")
    assert len(mesh.triangles) > 1000
    vertices = transform_points(np.linalg.inv(T), np.asarray(mesh.vertices))
    assert (np.abs(vertices[:, 2]) < 0.02).mean() > 0.2  # the table top


def test_distances_are_those_of_the_map(exported: tuple[MapExport, GaussianModel, np.ndarray], tmp_path: Path) -> None:
    export, model, _ = exported
    export.esdf()(tmp_path / "esdf.npz")
    grid = np.load(tmp_path / "esdf.npz")
    cells = np.argwhere(grid["distance_m"] < 0.5)[::997]
    points = grid["origin_m"] + cells * grid["voxel_m"]
    expected = GaussianCollisionField(model).clearance(points).distance
    np.testing.assert_allclose(grid["distance_m"][tuple(cells.T)], expected, atol=1e-5)


def test_occupied_voxels_touch_the_map_and_a_map_without_recording_has_no_free_ones(
    exported: tuple[MapExport, GaussianModel, np.ndarray], tmp_path: Path
) -> None:
    export, model, _ = exported
    export.octomap()(tmp_path / "map.bt")
    resolution, _, found = read_bt(tmp_path / "map.bt")
    assert resolution == VOXEL
    assert found
    assert all(found.values())
    assert any("recording cannot be read" in note for note in export.notes)
    centers = (np.array(list(found)) + 0.5) * VOXEL
    away = GaussianCollisionField(model).clearance(centers[::7]).distance
    assert away.max() <= VOXEL / 2 + 1e-6


def test_the_floor_plan_shows_what_stands_on_the_table(
    exported: tuple[MapExport, GaussianModel, np.ndarray], tmp_path: Path
) -> None:
    export = exported[0]
    for name, write in export.grid().items():
        write(tmp_path / name)
    text = (tmp_path / "grid.yaml").read_text()
    values = dict(line.split(": ", 1) for line in text.splitlines())
    header, size, _, pixels = (tmp_path / "grid.pgm").read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    image = np.frombuffer(pixels, np.uint8).reshape(height, width)
    assert header == b"P5"
    x, y, _ = (float(part) for part in values["origin"].strip("[]").split(","))

    def at(px: float, py: float) -> int:
        return int(image[height - 1 - int((py - y) / VOXEL), int((px - x) / VOXEL)])

    assert at(0.0, 0.0) == 0  # objects of 40 x 40 cm are in the middle of the table
    assert at(0.5, -0.3) == 205  # the bare table: not known to be free without a recording
    assert at(0.0, 0.75) == 0  # the wall


def test_a_grid_that_is_too_fine_says_which_voxel_fits(
    exported: tuple[MapExport, GaussianModel, np.ndarray],
) -> None:
    with pytest.raises(InputError, match="--voxel") as refused:
        MapExport.open(exported[0].file, voxel=0.001, n_sigma=2.0).octomap()
    voxel = float(str(refused.value.hint).split()[2])
    MapExport.open(exported[0].file, voxel=voxel, n_sigma=2.0)._box()
