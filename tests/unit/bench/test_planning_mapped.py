"""`splatbot bench planning --mapped` and `--run`: films of exact shapes, and exact clearances of paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.film import Film, FilmedMap, map_film, shoot
from splatbot.bench.planning.audit import STEP, audit, configurations
from splatbot.bench.planning.mapped_log import true_clearances
from splatbot.bench.planning_problems import CONSTANTS as PROBLEMS
from splatbot.bench.planning_problems import map_problems
from splatbot.bench.tabletop import tabletop
from splatbot.bench.truth import Truth
from splatbot.cli import main
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.geometry import transform_points
from splatbot.robots.panda import panda

DOWN = np.array([0.0, 1.3, 0.0, -0.9, 0.0, 2.2, 0.8])  # through the table top


@pytest.fixture(scope="module")
def film() -> Film:
    """A short one."""
    return shoot(tabletop(), 12, 160)


@pytest.fixture(scope="module")
def truth() -> Truth:
    """Depth image of the shapes."""
    return Truth(tabletop(), 0.1)


def test_a_film_shows_the_shapes_at_their_depth(film: Film) -> None:
    scene, errors = tabletop(), []
    for frame, T in zip(film.frames, film.T_scene_camera, strict=True):
        v, u = np.nonzero(frame.depth > 0)
        z = frame.depth[v, u].astype(np.float64)
        c = frame.camera
        points = transform_points(T, np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], axis=1))
        errors.append(np.abs(scene.distance(points))[points[:, 2] > -0.3])  # not the floor
    error = np.concatenate(errors)
    assert len(error) > 30_000
    assert 1e-4 < np.median(error) < 5e-3  # noisy, yet there


def test_the_map_of_a_film_lies_on_the_shapes(film: Film) -> None:
    mapped = map_film(Film(film.frames[:3], film.T_scene_camera[:3]))
    assert np.isfinite(mapped.T_world_camera).all()
    assert mapped.drift()[0] < 1e-9
    assert mapped.drift().max() < 0.02
    assert len(list(mapped.views())) == 3
    points = transform_points(np.linalg.inv(mapped.T_map_scene), mapped.snapshot.model.means.double().numpy())
    above = points[points[:, 2] > -0.3]
    assert np.median(np.abs(tabletop().distance(above))) < 0.015  # three small, noisy images


def test_what_no_frame_shows_is_unseen(film: Film) -> None:
    np.testing.assert_array_equal(film.observed(np.array([[0.9, -0.6, 0.0], [0.6, 0.0, -0.04]])), [True, False])


def test_a_lost_frame_is_no_view(film: Film) -> None:
    mapped = map_film(Film(film.frames[:1], film.T_scene_camera[:1]))
    lost = FilmedMap(film, mapped.snapshot, np.full((12, 4, 4), np.nan))
    assert list(lost.views()) == []
    assert np.isnan(lost.drift()).all()


def test_a_path_through_the_table_touches_what_was_seen(film: Film, truth: Truth) -> None:
    arm, path = RobotSpheres(panda()), np.stack([panda().home, DOWN])
    found = true_clearances([path, np.stack([panda().home, panda().home])], arm, truth, film)
    rooms, _ = audit([path], arm, truth)
    assert found.clearances[0] == rooms[0] < -0.01
    assert found.clearances[1] > 0
    np.testing.assert_array_equal(found.observed, [True, False])


def test_configurations_of_a_path_are_close_and_hold_its_waypoints(rng: np.random.Generator) -> None:
    path = rng.uniform(-1, 1, (4, 7))
    q = configurations(path)
    assert np.linalg.norm(np.diff(q, axis=0), axis=1).max() <= STEP + 1e-12
    for waypoint in path:
        assert (np.abs(q - waypoint).max(axis=1) < 1e-12).any()


def test_problems_in_a_map_end_within_the_box_and_keep_the_margin() -> None:
    field = GaussianCollisionField(tabletop().gaussians(5000))
    arm = RobotSpheres(panda(), margin=0.01)
    box = np.array([[0.2, -0.5, 0.0], [0.8, 0.5, 0.8]])
    found = map_problems(panda(), arm, field, box, 4)
    assert len(found) == 4
    ends = np.array([q for problem in found for q in (problem.start, problem.goal)])
    assert not arm.check(field, ends).in_collision.any()
    tool = panda().tcp(np.array([problem.goal for problem in found]))[:, :3, 3]
    assert ((tool > box[0]) & (tool < box[1])).all()
    assert (tool[:, 2] < PROBLEMS.max_goal_height).all()
    nothing = np.array([[5.0, 5.0, 0.0], [6.0, 6.0, 1.0]])
    assert map_problems(panda(), arm, field, nothing, 1) == []


def test_peers_and_maps_exclude_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "planning", "--mapped", "--peers"]) == 2
    assert "--peers" in capsys.readouterr().err


def test_a_run_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "planning", "--quick", "--run", str(tmp_path), "--out", str(tmp_path / "o")]) != 0
    assert "map.ply" in capsys.readouterr().err


@pytest.mark.long
def test_the_command_plans_on_the_map_of_a_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "planning", "--quick", "--mapped", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "in contact with the true shapes" in out
    assert {path.name for path in tmp_path.iterdir()} == {"planning-mapped.json", "planning-mapped.csv"}
