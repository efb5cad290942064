"""A map's folder defines the robot's base pose; the scene is then in the base frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.tabletop import Block, Tabletop
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, quat_multiply, rotation_to_quat, se3_exp, transform_points
from splatbot.protocols import Array
from splatbot.sim.maps.placed import placed_scene
from splatbot.sim.scene import SceneObject, make_scene
from splatbot.sim.solids import BoxGeom, rotation_of
from splatbot.sim.twin import Twin
from splatbot.workspace import Workspace

pytest.importorskip("mujoco")

T_WORLD_BASE = se3_exp([0.3, -0.2, 0.9, 1.8, 0.3, -0.4])
TABLE = Block((0.6, 0.0, -0.02), (0.8, 1.0, 0.04))
CARTON = Block((0.5, 0.15, 0.06), (0.10, 0.07, 0.12), 0.0)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run's folder whose map is in some other frame than the base's."""
    there = Tabletop((TABLE, CARTON)).gaussians(9000)
    means = transform_points(T_WORLD_BASE, there.means.double().numpy())
    quats = quat_multiply(rotation_to_quat(T_WORLD_BASE[:3, :3]), there.quats.double().numpy())
    model = GaussianModel.from_activated(
        means=means, quats=quats, scales=there.scales, opacities=there.opacities, colors=there.colors
    )
    model.save(tmp_path / "map.ply")
    return tmp_path


def _workspace() -> Workspace:
    up = T_WORLD_BASE[:3, 2]
    return Workspace(T_WORLD_BASE, -up, np.append(up, -float(up @ T_WORLD_BASE[:3, 3])))


@pytest.mark.parametrize("file", ["", "map.ply"])
def test_the_table_and_the_carton_are_where_they_are_from_the_base(run: Path, file: str) -> None:
    _workspace().save(run / "scene.yaml")
    scene = make_scene(placed_scene(run / file))
    np.testing.assert_allclose(scene.gravity, [0, 0, -9.81], atol=1e-6)
    world = Twin(scene).world
    objects = {obj.name: obj for obj in world.scene.objects}
    assert _top(objects["map-table"]) == pytest.approx([0.6, 0.0, 0.0], abs=1e-3)
    assert _top(objects["map-table"])[2] == pytest.approx(0.0, abs=1e-5)
    np.testing.assert_allclose(objects["map-box-1"].at[:2], [0.5, 0.15], atol=2e-3)


def test_a_plane_that_is_given_counts_more_than_one_that_would_be_found(run: Path) -> None:
    up = T_WORLD_BASE[:3, 2]
    at = T_WORLD_BASE[:3, 3] + 0.004 * up
    Workspace(T_WORLD_BASE, None, np.append(up, -float(up @ at))).save(run / "scene.yaml")
    table = Twin(make_scene(placed_scene(run))).world.scene.objects[0]
    assert _top(table)[2] == pytest.approx(0.004, abs=1e-5)


def _top(table: SceneObject) -> Array:
    """Return the centre of a table's upper face (3,) [m]."""
    (shape,) = table.shapes
    assert isinstance(shape, BoxGeom)
    return np.asarray(table.at) + rotation_of(table.rpy)[:, 2] * shape.size[2] / 2


def test_a_mount_that_leans_feels_gravity_from_the_side(run: Path) -> None:
    down = T_WORLD_BASE[:3, :3] @ np.array([np.sin(0.1), 0.0, -np.cos(0.1)])
    Workspace(T_WORLD_BASE, down).save(run / "scene.yaml")
    np.testing.assert_allclose(placed_scene(run)["gravity"], 9.81 * np.array([np.sin(0.1), 0, -np.cos(0.1)]), atol=1e-6)


def test_a_run_that_does_not_say_where_the_robot_stands_is_refused(run: Path) -> None:
    with pytest.raises(InputError, match="does not define the base pose") as caught:
        placed_scene(run)
    assert "--fit-plane" in (caught.value.hint or "")


def test_a_file_without_a_scene_is_in_the_robots_frame(run: Path) -> None:
    assert set(placed_scene(run / "map.ply")["map"]) == {"file"}


def test_a_folder_without_a_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no map.ply"):
        placed_scene(tmp_path)


def test_a_point_of_the_map_lies_where_the_base_sees_it(run: Path) -> None:
    _workspace().save(run / "scene.yaml")
    clutter = make_scene(placed_scene(run)).map
    assert clutter is not None
    from splatbot.sim.solids import rotation_of

    point = np.array([0.1, 0.2, 0.3])
    seen = rotation_of(clutter.rpy) @ point + clutter.at
    np.testing.assert_allclose(seen, transform_points(inverse(T_WORLD_BASE), point[None])[0], atol=1e-6)
