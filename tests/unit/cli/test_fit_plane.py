"""`splatbot info --fit-plane`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbot.workspace import Workspace
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
    assert "the file" in run("info", tmp_path, "--fit-plane").out
    assert (tmp_path / "scene.yaml").read_bytes() == before


def test_a_log_has_no_plane_to_fit(run: RunCommand) -> None:
    answer = run("info", "synthetic:tabletop?frames=3&width=64&height=48", "--fit-plane")
    assert answer.code == 2
    assert "--fit-plane: needs a map" in answer.err
