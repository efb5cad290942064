"""`splatbot info --fit-plane`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbot.gaussians import GaussianModel
from splatbot.workspace import NamedPlace, Workspace
from tests.unit.cli.conftest import RunCommand
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
    n = len(wall)
    GaussianModel.from_activated(
        means=wall, quats=np.tile([1.0, 0, 0, 0], (n, 1)), scales=np.full((n, 3), 0.01),
        opacities=np.full(n, 0.9), colors=np.full((n, 3), 0.5),
    ).save(tmp_path / "map.ply")  # fmt: skip
    answer = run("info", tmp_path, "--fit-plane")
    assert answer.code == 1
    assert "nothing is written" in answer.out
    assert "a wall in front of it looks alike" in answer.out
    assert "nothing stands on the plane" in answer.out
    assert "--fit-plane --up" in answer.out
    assert not (tmp_path / "scene.yaml").exists()
    assert (tmp_path / "scene.png").exists()


def test_up_without_a_plane_to_fit_is_refused(run: RunCommand, tmp_path: Path) -> None:
    _table()[0].save(tmp_path / "map.ply")
    assert run("info", tmp_path, "--up", 0, 0, -1).code == 2
