"""Scene files: every shipped one loads, and errors name the key."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.errors import ConfigError, InputError
from splatbot.sim.motion import motion_of
from splatbot.sim.scene import load_scene, make_scene, scene_names
from splatbot.sim.twin import Twin

pytest.importorskip("mujoco")


def _write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", scene_names())
def test_a_shipped_scene_is_named_as_its_file_and_says_what_it_is_for(name: str) -> None:
    scene = load_scene(name)
    assert scene.name == name
    assert len(scene.about) > 10


@pytest.mark.parametrize(
    ("text", "field", "message"),
    [
        ("objects: [{name: a, shapes: [{kind: cube}]}]", "objects.0.shapes.0", "cube"),
        ("objects: [{name: a, shapes: [{kind: sphere, radius: -1}]}]", "radius", "greater than 0"),
        ("gravty: [0, 0, 0]", "gravty", "Extra inputs"),
        ("timestep: 0.5", "timestep", "less than or equal to 0.05"),
        ("effects: {force: [magic]}", "scene", "there is no 'magic'; physics: soft_bodies"),
        ("effects: {force: [contact], forbid: [contact]}", "scene", "forced and forbidden"),
        ("task: {moves: [{t: 2}, {t: 1}]}", "task", "times of moves must increase"),
        ("objects: [{name: a, shapes: [{kind: plane}], movable: true}]", "objects.0", "a plane has no end"),
        (
            "objects: [{name: a, shapes: [{kind: plane}]}, {name: a, shapes: [{kind: plane}]}]",
            "scene",
            "'a' is there twice",
        ),
        ("gravity: [0, 0, .nan]", "gravity", "finite"),
    ],
)
def test_a_mistake_is_named_with_file_and_field(text: str, field: str, message: str, tmp_path: Path) -> None:
    path = _write(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        load_scene(path)
    assert str(path) in str(error.value)
    assert field in (error.value.field or "")
    assert message in error.value.message


def test_an_unknown_scene_is_answered_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"there is no scene 'kitchen'.*empty, .*wiping"):
        load_scene("kitchen")


def test_a_mesh_is_looked_for_beside_the_scene_file(tmp_path: Path) -> None:
    path = _write(tmp_path, "objects: [{name: a, shapes: [{kind: mesh, file: b.stl}]}]")
    with pytest.raises(ConfigError, match=r"b\.stl: mesh\.file: is not there"):
        Twin(load_scene(path))


def test_a_mesh_of_points_has_the_mass_it_is_given() -> None:
    corners = [[x, y, z] for x in (-0.02, 0.02) for y in (-0.03, 0.03) for z in (-0.01, 0.01)]
    brick = {"name": "brick", "shapes": [{"kind": "mesh", "points": corners}], "movable": True, "mass": 0.7}
    twin = Twin(make_scene({"name": "x", "robot": None, "objects": [brick]}))
    body = twin.world.model.body("object/brick")
    assert body.mass[0] == pytest.approx(0.7)
    expected = sorted(0.7 / 12 * (a * a + b * b) for a, b in ((0.04, 0.06), (0.04, 0.02), (0.06, 0.02)))
    assert sorted(body.inertia) == pytest.approx(expected, rel=1e-6)


def test_a_place_out_of_reach_is_named() -> None:
    scene = make_scene({"name": "x", "task": {"kind": "reach", "moves": [{"t": 1.0, "tcp": [3.0, 0.0, 0.5]}]}})
    robot = Twin(scene).world.robot
    assert robot is not None
    with pytest.raises(InputError, match=r"task\.moves\.tcp: \(3\.0, 0\.0, 0\.5\) cannot be reached"):
        motion_of(scene, robot)
