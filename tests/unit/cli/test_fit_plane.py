"""`splatbot info --fit-plane`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbot.gaussians import GaussianModel
from splatbot.workspace import NamedPlace, Workspace
from tests.unit.cli.conftest import RunCommand, assert_refused
from tests.unit.test_workspace import _table


def test_a_workspace_is_estimated_written_once_and_read_the_next_time(run: RunCommand, tmp_path: Path) -> None:
    model, T = _table()
    model.save(tmp_path / "map.ply")
    answer = run("info", tmp_path, "--fit-plane")
    assert answer.code == 0, answer.err
    assert "estimated, written" in answer.out
    found = Workspace.load(tmp_path / "scene.yaml")
    assert found.support_plane is not None
    np.testing.assert_allclose(found.support_plane[:3], T[:3, 2], atol=0.01)
    before = (tmp_path / "scene.yaml").read_bytes()
    assert (tmp_path / "scene.png").exists()
    assert "the file" in run("info", tmp_path, "--fit-plane").out
    assert (tmp_path / "scene.yaml").read_bytes() == before


def test_a_log_has_no_plane_to_fit(run: RunCommand) -> None:
    answer = run("info", "synthetic:tabletop?frames=3&width=64&height=48", "--fit-plane")
    assert answer.code == 2
    assert "--fit-plane: needs a map" in answer.err


def test_the_given_up_direction_replaces_the_written_plane_and_keeps_the_rest(run: RunCommand, tmp_path: Path) -> None:
    model, T = _table()
    model.save(tmp_path / "map.ply")
    things = (NamedPlace("cup", np.array([0.1, 0.2, 0.3])),)
    Workspace(gravity=np.array([1.0, 0.0, 0.0]), objects=things).save(tmp_path / "scene.yaml")
    answer = run("info", tmp_path, "--fit-plane", "--up", *T[:3, 2])
    assert answer.code == 0, answer.err
    assert "replaced" in answer.out
    found = Workspace.load(tmp_path / "scene.yaml")
    assert found.gravity is not None
    np.testing.assert_allclose(found.gravity, -T[:3, 2], atol=0.01)
    assert [thing.name for thing in found.objects] == ["cup"]


def test_a_doubtful_estimate_asks_and_writes_nothing_but_its_picture(run: RunCommand, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    wall = np.c_[rng.uniform(-1, 1, (4000, 2)), rng.normal(2.0, 1e-3, 4000)]  # a bare wall in front of the camera
    _model(wall).save(tmp_path / "map.ply")
    answer = run("info", tmp_path, "--fit-plane")
    assert answer.code == 1
    assert "nothing is written" in answer.out
    assert "a wall in front of it looks alike" in answer.out
    assert "nothing stands on the plane" in answer.out
    for up in ("0 0 -1", "0 -0.707 -0.707"):  # the wall faces both, and no direction straight up
        assert f"splatbot info {tmp_path} --fit-plane --up {up}\n" in answer.out
    assert "--up 0 -1 0\n" not in answer.out
    assert not (tmp_path / "scene.yaml").exists()
    assert (tmp_path / "scene.png").exists()


def test_a_doubtful_plane_in_a_given_direction_is_used_and_the_note_says_why(run: RunCommand, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    floor = np.c_[rng.uniform(-1, 1, 4000), rng.normal(0.5, 1e-3, 4000), rng.uniform(0.5, 2.5, 4000)]
    _model(floor).save(tmp_path / "map.ply")
    answer = run("info", tmp_path, "--fit-plane", "--up", 0, -1, 0)
    assert answer.code == 0, answer.err
    assert "nothing stands on the plane" in answer.out
    assert "the plane is used, because --up gives the direction" in answer.out
    assert Workspace.load(tmp_path / "scene.yaml").base_proposed


def test_the_base_moves_along_its_own_axes_and_is_a_proposal_no_more(run: RunCommand, tmp_path: Path) -> None:
    _table()[0].save(tmp_path / "map.ply")
    assert run("info", tmp_path, "--fit-plane").code == 0
    before = Workspace.load(tmp_path / "scene.yaml")
    assert before.base_proposed
    answer = run("info", tmp_path, "--fit-plane", "--base-offset", -0.2, 0.4, 0.6)
    assert answer.code == 0, answer.err
    assert "the file, with the base moved, replaced" in answer.out
    after = Workspace.load(tmp_path / "scene.yaml")
    assert before.T_world_base is not None
    assert after.T_world_base is not None
    moved = np.linalg.inv(before.T_world_base) @ after.T_world_base
    expected = np.eye(4)
    expected[:3, 3] = [-0.2, 0.4, 0.6]
    np.testing.assert_allclose(moved, expected, atol=2e-6)
    assert before.box is not None
    assert after.box is not None
    np.testing.assert_allclose(after.box, before.box - expected[:3, 3], atol=2e-6)
    assert after.support_plane is not None
    assert before.support_plane is not None
    np.testing.assert_array_equal(after.support_plane, before.support_plane)
    assert not after.base_proposed
    answer = run("info", tmp_path, "--fit-plane", "--base-offset", 600, 0, 0)
    assert_refused(answer, "base offset: is [600.0, 0.0, 0.0]. Fix: give metres, at most 100")
    answer = run("info", tmp_path, "--fit-plane", "--support", 0)
    assert answer.code == 0, answer.err
    assert "and was not a proposal" in answer.out


def test_a_support_of_the_list_carries_the_base(run: RunCommand, tmp_path: Path) -> None:
    model, T = _stool()
    model.save(tmp_path / "map.ply")
    assert run("info", tmp_path, "--fit-plane", "--up", 0, -1, 0).code == 0
    answer = run("info", tmp_path, "--fit-plane", "--support", 1)
    assert answer.code == 0, answer.err
    found = Workspace.load(tmp_path / "scene.yaml")
    assert found.T_world_base is not None
    assert abs(found.T_world_base[1, 3] - T) < 0.01  # y is down in the world of the camera
    answer = run("info", tmp_path, "--fit-plane", "--support", 7)
    assert answer.code == 2
    assert "--support: is 7" in answer.err
    assert "0 at" in answer.err


def _stool() -> tuple[GaussianModel, float]:
    """Return a floor 1 m below the camera with a stool of 0.4 m on it, and the world's y of its seat."""
    rng = np.random.default_rng(2)
    floor = np.c_[rng.uniform(-1.5, 1.5, 8000), rng.normal(1.0, 1e-3, 8000), rng.uniform(0.5, 3.0, 8000)]
    under = (np.abs(floor[:, 0]) < 0.25) & (np.abs(floor[:, 2] - 1.5) < 0.25)
    seat = np.c_[rng.uniform(-0.25, 0.25, 3000), rng.normal(0.6, 1e-3, 3000), rng.uniform(1.25, 1.75, 3000)]
    cup = np.c_[rng.uniform(-0.04, 0.04, 300), rng.uniform(0.5, 0.6, 300), rng.uniform(1.46, 1.54, 300)]
    return _model(np.concatenate([floor[~under], seat, cup])), 0.6


def _model(points: np.ndarray) -> GaussianModel:
    n = len(points)
    return GaussianModel.from_activated(
        means=points, quats=np.tile([1.0, 0, 0, 0], (n, 1)), scales=np.full((n, 3), 0.01),
        opacities=np.full(n, 0.9), colors=np.full((n, 3), 0.5),
    )  # fmt: skip


def test_up_without_a_plane_to_fit_is_refused(run: RunCommand, tmp_path: Path) -> None:
    _table()[0].save(tmp_path / "map.ply")
    assert run("info", tmp_path, "--up", 0, 0, -1).code == 2
