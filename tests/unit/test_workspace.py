"""scene.yaml: read, written, found, estimated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import transform_points
from splatbot.workspace import NAME, NamedPlace, Workspace, find_workspace, fit_workspace


def _table(seed: int = 0) -> tuple[GaussianModel, np.ndarray]:
    """Return a table with objects and a larger wall behind it, seen from 0.5 m above, and T_world_table."""
    rng = np.random.default_rng(seed)
    table = np.c_[rng.uniform(-0.6, 0.6, 3000), rng.uniform(-0.4, 0.4, 3000), rng.normal(0, 1e-3, 3000)]
    wall = np.c_[rng.uniform(-2, 2, 6000), np.full(6000, 0.75), rng.uniform(-0.7, 1.5, 6000)]
    things = rng.uniform([-0.2, -0.2, 0], [0.2, 0.2, 0.15], (1500, 3))
    # The camera looks down by 40 degrees from 0.8 m before the table's middle and 0.6 m over it.
    turn = np.radians(40.0)
    T_table_world = np.eye(4)
    T_table_world[:3, :3] = np.array([[1, 0, 0], [0, -np.sin(turn), np.cos(turn)], [0, -np.cos(turn), -np.sin(turn)]])
    T_table_world[:3, 3] = [0.0, -0.8, 0.6]
    T = np.linalg.inv(T_table_world)
    points = transform_points(T, np.concatenate([table, wall, things]))
    n = len(points)
    model = GaussianModel.from_activated(
        means=points, quats=np.tile([1.0, 0, 0, 0], (n, 1)), scales=np.full((n, 3), 0.01),
        opacities=np.full(n, 0.9), colors=np.full((n, 3), 0.5),
    )  # fmt: skip
    return model, T


def test_the_table_is_found_before_a_larger_wall_and_the_base_stands_on_it() -> None:
    model, T = _table()
    found = fit_workspace(model)
    assert found.support_plane is not None
    assert found.gravity is not None
    assert found.T_world_base is not None
    assert found.box is not None
    up = T[:3, 2]
    assert np.degrees(np.arccos(np.clip(found.support_plane[:3] @ up, -1, 1))) < 0.5
    assert abs(found.support_plane[:3] @ T[:3, 3] + found.support_plane[3]) < 2e-3
    np.testing.assert_allclose(found.gravity, -found.support_plane[:3])
    base = np.linalg.inv(T) @ found.T_world_base  # in the table's frame
    np.testing.assert_allclose(base[:3, 3], [0.0, -0.55, 0.0], atol=0.03)
    np.testing.assert_allclose(base[:3, 0], [0.0, 1.0, 0.0], atol=0.03)
    np.testing.assert_allclose(base[:3, 2], [0.0, 0.0, 1.0], atol=0.01)
    np.testing.assert_allclose(found.box[:, 1], [-0.6, 0.6], atol=0.05)


def test_the_cameras_mount_is_kept_and_a_bad_one_refused(tmp_path: Path) -> None:
    T = np.eye(4)
    T[:3, 3] = [0.05, 0.0, 0.1]
    Workspace(T_link_camera=T, camera_link=6).save(tmp_path / "scene.yaml")
    again = Workspace.load(tmp_path / "scene.yaml")
    assert again.camera_link == 6
    assert again.T_link_camera is not None
    np.testing.assert_allclose(again.T_link_camera, T, atol=1e-9)
    (tmp_path / "scene.yaml").write_text("camera_link: hand\n")
    with pytest.raises(FormatError, match="camera_link"):
        Workspace.load(tmp_path / "scene.yaml")
    with pytest.raises(InputError, match="T_link_camera"):
        Workspace(T_link_camera=np.ones((4, 4)))


def test_what_is_written_is_read_and_found_beside_a_map(tmp_path: Path) -> None:
    found = fit_workspace(_table()[0])
    found.save(tmp_path / "scene.yaml")
    again = find_workspace(None, tmp_path / "elsewhere" / "map.ply", tmp_path / "map.ply")
    assert again is not None
    for name in ("T_world_base", "gravity", "support_plane", "box"):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), atol=1e-6)
    assert find_workspace(tmp_path / "elsewhere") is None
    Workspace(gravity=np.array([0.0, 0, -1])).save(tmp_path / "scene.yaml")
    part = Workspace.load(tmp_path / "scene.yaml")
    assert part.T_world_base is None
    np.testing.assert_array_equal(part.gravity, [0, 0, -1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2", "cannot be read"),
        ("- 1\n", "no mapping"),
        ("gravitation: [0, 0, 1]\n", "gravitation"),
        ("gravity: [0, 0, 2]\n", "gravity: is no unit vector"),
        ("gravity: [0, 0]\n", r"gravity: is \(2,\)"),
        ("gravity: [a, b, c]\n", "gravity: holds a value that is no number"),
        ("T_world_base: [1, 2, 3]\n", "T_world_base: is no pose"),
        ("T_world_base: {translation: [0, 0, 0], quaternion_wxyz: [0, 0, 0, 0]}\n", "quaternion"),
        ("workspace: [[0, 0, 0], [1, 0, 1]]\n", "workspace: is empty"),
    ],
)
def test_a_damaged_file_is_named_with_its_field(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        Workspace.load(path)


def test_a_map_without_an_upward_surface_is_refused() -> None:
    rng = np.random.default_rng(0)
    n = 3000
    model = GaussianModel.from_activated(
        means=rng.uniform(-1, 1, (n, 3)), quats=np.tile([1.0, 0, 0, 0], (n, 1)), scales=np.full((n, 3), 0.01),
        opacities=np.full(n, 0.9), colors=np.full((n, 3), 0.5),
    )  # fmt: skip
    with pytest.raises(InputError, match="no upward surface"):
        fit_workspace(model)
    with pytest.raises(InputError, match="up"):
        fit_workspace(model, up=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="Gaussians"):
        fit_workspace(GaussianModel.empty())


def test_names_of_things_are_written_and_read_again(tmp_path: Path) -> None:
    things = (NamedPlace("cup", np.array([0.1, 0.2, 0.3]), ("mug",)), NamedPlace("box", np.array([1.0, 0.0, 0.0])))
    Workspace(objects=things).save(tmp_path / "scene.yaml")
    found = Workspace.load(tmp_path / "scene.yaml").objects
    assert [(o.name, o.aliases, o.at.tolist()) for o in found] == [(o.name, o.aliases, o.at.tolist()) for o in things]


@pytest.mark.parametrize("text", ["cup", "[cup]", "[{name: cup}]", "[{name: cup, at: [1, 2]}]", "[{at: [1, 2, 3]}]"])
def test_things_without_name_or_place_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(f"objects: {text}\n")
    with pytest.raises(FormatError, match="objects"):
        Workspace.load(tmp_path / "scene.yaml")


def test_the_scene_of_a_log_is_found_by_its_address_with_options(tmp_path: Path) -> None:
    Workspace(camera_link=0, T_link_camera=np.eye(4), joint_delay=0.05, tf_prefix="left_").save(tmp_path / NAME)
    (tmp_path / "a.mcap").touch()
    for address in (f"{tmp_path}/a.mcap?color=/wrist/image_raw", f"{tmp_path}?tolerance=0.05", tmp_path):
        found = find_workspace(address)
        assert found is not None
        assert found.joint_delay == 0.05
        assert found.tf_prefix == "left_"
    assert find_workspace("synthetic:tabletop?" + "effects=a;" * 1000) is None


@pytest.mark.parametrize("text", ["/left", "3", "[left_]", "a" * 129])
def test_a_prefix_of_tf_that_no_frame_can_have_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(f"tf_prefix: {text}\n")
    with pytest.raises(FormatError, match="tf_prefix"):
        Workspace.load(tmp_path / "scene.yaml")
