"""A map becomes a table, objects and ellipsoids that are where its surfaces are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatbot.bench.tabletop import Ball, Block, Can, Tabletop
from splatbot.collision import GaussianCollisionField
from splatbot.errors import ConfigError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_to_rotation
from splatbot.robots.panda import panda
from splatbot.segmentation import find_support, fit
from splatbot.sim.clutter import REPRESENTED, MapParts, map_parts
from splatbot.sim.maps.ellipsoids import merge
from splatbot.sim.motion import hold
from splatbot.sim.scene import Clutter, make_scene
from splatbot.sim.solids import BoxGeom
from splatbot.sim.twin import Twin

pytest.importorskip("mujoco")

TABLE = Block((0.6, 0.0, -0.02), (0.8, 1.0, 0.04))
CARTON = Block((0.45, 0.10, 0.06), (0.10, 0.07, 0.12), 0.4)
CAN = Can((0.60, -0.20, 0.0), 0.035, 0.12)
BALL = Ball((0.55, 0.30, 0.05), 0.05)
WALL = Block((0.95, 0.0, 0.40), (0.04, 0.9, 0.60))


@cache
def scanned() -> GaussianModel:
    return Tabletop((TABLE, CARTON, CAN, BALL, WALL)).gaussians(20_000)


@cache
def parts() -> MapParts:
    return map_parts(scanned(), Clutter(file="scan.ply"), np.zeros(3))


def test_the_table_is_found_to_a_tenth_of_a_millimetre_and_level() -> None:
    (table,) = (t for t in parts().objects if t.name == "map-table")
    (shape,) = table.shapes
    assert isinstance(shape, BoxGeom)
    assert abs(table.at[2] + shape.size[2] / 2) < 1e-3  # the table's top is at 0
    assert np.abs(table.rpy[:2]).max() < 2e-3


def test_the_table_ends_where_it_was_seen_to_end() -> None:
    """An arm that reaches past its edge and lower has no contact; on an infinite plane it would."""
    (table,) = (t for t in parts().objects if t.name == "map-table")
    (shape,) = table.shapes
    assert isinstance(shape, BoxGeom)
    assert sorted(shape.size[:2]) == pytest.approx([0.8, 1.0], abs=0.02)
    np.testing.assert_allclose(table.at[:2], TABLE.center[:2], atol=0.01)


def test_a_table_of_which_nothing_was_seen_has_no_end() -> None:
    """The plane is given, 5 cm under the table's bottom."""
    found = map_parts(scanned(), Clutter(file="scan.ply", support=(0.0, 0.0, 1.0, 0.09)), np.zeros(3))
    (table,) = (t for t in found.objects if t.name == "map-table")
    assert table.shapes[0].kind == "plane"
    assert table.at[2] == pytest.approx(-0.09)


def test_what_no_depth_supports_is_air_to_physics_as_it_is_to_the_field() -> None:
    """A cloud of Gaussians that only carry colour, in front of the arm."""
    cloud = scanned().select(torch.arange(50))
    cloud.means[:] = torch.tensor([0.5, 0.0, 0.5]) + 0.02 * torch.randn(
        50, 3, generator=torch.Generator().manual_seed(0)
    )
    unseen = replace(cloud, observations=torch.zeros(50, dtype=torch.int32))
    found = map_parts(GaussianModel.concatenate([scanned(), unseen]), Clutter(file="scan.ply"), np.zeros(3))
    assert found.labels[-50:].tolist() == [-2] * 50
    seen = map_parts(GaussianModel.concatenate([scanned(), cloud]), Clutter(file="scan.ply"), np.zeros(3))
    assert set(seen.labels[-50:].tolist()) != {-2}


def test_ellipsoids_extend_little_beyond_what_the_collision_field() -> None:
    """Compare the note with points of the surface that the conversion did not sample, on the field itself."""
    found = parts().ellipsoids
    field = GaussianCollisionField(scanned(), min_opacity=0.3)
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    R = quat_to_rotation(found.quats)
    points = found.centers[:, None] + np.einsum("eij,epj->epi", R, found.axes[:, None] * directions)
    distance = field.clearance(points.reshape(-1, 3)).distance.reshape(len(R), -1).max(axis=1)
    assert np.percentile(distance, 95) < 0.012
    (note,) = (note for note in parts().notes if note.startswith("clutter"))
    reported = float(note.split("beyond the collision field (95 %: ")[1].split(" mm")[0])
    assert 1e3 * float(np.percentile(distance, 95)) == pytest.approx(reported, abs=2.0)


def test_things_on_the_table_are_what_they_are() -> None:
    kinds = sorted(obj.shapes[0].kind for obj in parts().objects)
    assert kinds == ["box", "box", "cylinder", "sphere"]
    by_kind = {obj.shapes[0].kind: obj for obj in parts().objects if obj.name != "map-table"}
    np.testing.assert_allclose(by_kind["sphere"].at, BALL.center, atol=2e-3)
    np.testing.assert_allclose(by_kind["cylinder"].at, [0.60, -0.20, 0.06], atol=4e-3)
    np.testing.assert_allclose(by_kind["box"].at, CARTON.center, atol=4e-3)
    np.testing.assert_allclose(sorted(by_kind["box"].shapes[0].size), sorted(CARTON.size), atol=6e-3)  # type: ignore[union-attr]


def test_the_rest_is_at_most_as_many_ellipsoids_as_the_limit_and_near_the_surface() -> None:
    """How far the ellipsoids' flat sides are from the true surfaces: of the wall, and of the table's rim and bottom."""
    found = parts().ellipsoids
    assert 200 < len(found.centers) <= 2000
    tips = (
        found.centers[:, None]
        + np.array([-1.0, 1.0])[None, :, None] * (found.axes[:, :1] * _first_axes(found.quats))[:, None]
    )
    outside = np.abs(Tabletop((TABLE, WALL)).distance(tips.reshape(-1, 3)))
    assert float(np.percentile(outside, 95)) < 0.01
    assert float(np.median(outside)) < 0.003
    assert found.error < 0.004


def test_every_gaussian_has_a_label_and_notes_tell_the_errors() -> None:
    labels = parts().labels
    assert len(labels) == len(scanned())
    assert set(labels.tolist()) >= {-1, 0, 1, 2, 3}
    assert len(parts().notes) == 5
    assert all("mm" in note for note in parts().notes)


def test_fewer_ellipsoids_are_larger_and_err_more() -> None:
    rng = np.random.default_rng(0)
    turn = rng.uniform(0, 2 * np.pi, 4000)
    points = np.c_[0.3 * np.cos(turn), 0.3 * np.sin(turn), rng.uniform(0, 0.4, 4000)]
    spread = np.tile(np.eye(3) * 1e-6, (4000, 1, 1))
    many, few = (merge(points, spread, np.ones(4000), np.zeros(3), limit) for limit in (1000, 50))
    assert len(few.centers) <= 50 < len(many.centers) <= 1000
    assert few.error > 1.5 * many.error


def test_a_scene_of_a_map_runs_and_the_arm_hits_its_wall(tmp_path: Path) -> None:
    scanned().save(tmp_path / "scan.ply")
    moves = [{"t": 1.5, "tcp": [0.75, 0.0, 0.45], "rpy": [0.0, 1.5707963, 0.0]}, {"t": 2.5, "tcp": [0.80, 0.0, 0.45],
             "rpy": [0.0, 1.5707963, 0.0]}]  # fmt: skip
    scene = make_scene(
        {"name": "scan", "map": {"file": str(tmp_path / "scan.ply")}, "task": {"kind": "reach", "moves": moves}}
    )
    result = Twin(scene).follow(until_contact=True)
    assert result.clearance.value < 0.12
    assert len(result.notes) == 5  # the arm stands next to the table, not in it


def test_a_part_of_the_map_without_gaussians_is_an_error() -> None:
    with pytest.raises(InputError, match=r"none of .* Gaussians is solid and between"):
        map_parts(scanned(), Clutter(file="scan.ply", low=(5, 5, 5), high=(6, 6, 6)), np.zeros(3))


def test_a_wall_is_no_support_and_a_few_points_are_none() -> None:
    rng = np.random.default_rng(1)
    wall = np.c_[np.zeros(500), rng.uniform(-1, 1, (500, 2))]
    assert find_support(wall) is None
    assert find_support(wall[:10]) is None


def test_a_map_that_is_not_there_is_named() -> None:
    with pytest.raises((ConfigError, InputError), match=r"nowhere\.ply"):
        Twin(make_scene({"name": "x", "map": {"file": "nowhere.ply"}}))


def _first_axes(quats: np.ndarray) -> np.ndarray:
    return quat_to_rotation(quats)[:, :, 0]


@pytest.mark.parametrize(("degree", "camera", "on"), [(2, True, True), (2, False, False), (0, True, False)])
def test_harmonics_are_evaluated_only_where_a_camera_sees_some(
    tmp_path: Path, degree: int, camera: bool, on: bool
) -> None:
    model = scanned()
    coefficients = torch.zeros(len(model), (degree + 1) ** 2, 3)
    coefficients[:, :1] = model.sh
    replace(model, sh=coefficients).save(tmp_path / "scan.ply")
    values: dict[str, Any] = {"name": "scan", "map": {"file": str(tmp_path / "scan.ply")}}
    if camera:
        values["camera"] = {"at": [1.5, -0.5, 0.9], "look_at": [0.5, 0.0, 0.2]}
    scenes = [make_scene(values).with_effects(forbid=forbidden) for forbidden in ((), ("view_color",))]
    results = [Twin(scene).follow(hold(panda().home, 0.02)) for scene in scenes]
    assert results[0].figures["harmonics"] == (degree if on else 0)
    assert results[1].figures["harmonics"] == 0
    (decision,) = (d for d in results[0].decisions if d.name == "view_color")
    assert decision.on == on
    assert decision.why


def test_strays_of_a_thing_that_may_move_go_with_it() -> None:
    """Isolated Gaussians 3 cm next to the carton and farther; as clutter they would block it."""
    strays = scanned().select(torch.arange(3))
    strays.means[:] = torch.tensor([[0.45, 0.10, 0.147], [0.36, 0.10, 0.06], [0.45, 0.30, 0.12]])
    model = GaussianModel.concatenate([scanned(), strays])
    held, free = (map_parts(model, Clutter(file="scan.ply", movable=m), np.zeros(3)) for m in (False, True))
    kinds = [obj.shapes[0].kind if obj.name != "map-table" else "" for obj in free.objects]
    carton = kinds.index("box")
    assert held.labels[-3:].tolist() == [-1, -1, -1]
    assert free.labels[-3] == carton
    assert free.labels[-1] == -1
    assert np.count_nonzero(free.labels == -1) < np.count_nonzero(held.labels == -1)


def test_a_hull_stands_on_the_floor_although_its_lowest_points_are_above_it() -> None:
    rng = np.random.default_rng(0)
    u = rng.uniform(0, 2 * np.pi, 4000)
    z = rng.uniform(0.012, 0.12, 4000)
    r = 0.04 * (1 - z / 0.2) * (1 + 0.6 * (np.cos(u) > 0))  # neither a box, nor a cylinder, nor a ball
    found = fit(np.stack([r * np.cos(u) + 0.5, r * np.sin(u), z], axis=1), 0.0)
    assert found.shape["kind"] == "mesh"
    assert found.at[2] + np.array(found.shape["points"])[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_a_ring_that_lies_flat_is_no_ball_and_a_ball_of_which_the_top_was_seen_is_one() -> None:
    rng = np.random.default_rng(0)
    u, r, z = rng.uniform(0, 2 * np.pi, 3000), 0.035 + 0.003 * rng.standard_normal(3000), rng.uniform(0.005, 0.02, 3000)
    flat = fit(np.stack([r * np.cos(u), r * np.sin(u), z], axis=1), 0.0)
    assert flat.shape["kind"] != "sphere"
    top = rng.standard_normal((3000, 3))
    top[:, 2] = np.abs(top[:, 2])
    top = 0.04 * top / np.linalg.norm(top, axis=1, keepdims=True) + [0.0, 0.0, 0.04]
    found = fit(top, 0.0)
    assert found.shape["kind"] == "sphere"
    assert found.shape["radius"] == pytest.approx(0.04, abs=1e-6)


def test_gaussians_that_an_object_of_the_scene_represents_are_no_obstacle() -> None:
    x, y, z = BALL.center
    left = map_parts(scanned(), Clutter(file="scan.ply", without=((x, y, z, BALL.radius + 0.005),)), np.zeros(3))
    on_ball = np.abs(BALL.distance(scanned().means.double().numpy())) < 1e-3
    on_ball &= scanned().means[:, 2].numpy() > 0.01
    assert (left.labels[on_ball] == REPRESENTED).all()
    assert len(left.objects) == len(parts().objects) - 1
