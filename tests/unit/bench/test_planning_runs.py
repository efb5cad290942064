"""`splatbot bench planning --run`: an arm in the map of a recording."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.planning.recorded_run import free_place, plan_in_run
from splatbot.bench.results import Results
from splatbot.cli import main
from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.workspace import CONSTANTS as WORKSPACE
from splatbot.workspace import Workspace


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a small table."""
    folder = tmp_path_factory.mktemp("run") / "table"
    log = "synthetic:tabletop?frames=4&width=160&height=120"
    assert main(["map", log, "--out", str(folder), "--quiet"]) == 0
    return folder


def test_problems_in_a_run_are_solved_certified_and_off_what_was_measured(recorded: Path, tmp_path: Path) -> None:
    assert main(["bench", "planning", "--quick", "--run", str(recorded), "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "planning-mapped.json").read_text())["rows"]
    cases = sorted({row["case"] for row in rows})
    assert len(cases) == 3
    for case in cases:
        found = {row["metric"]: row["value"] for row in rows if row["case"] == case}
        assert found["solved"] == found["certified"] == found["problems found"] == 2
        assert found["certified clearance beyond the margin, least"] >= 0
        assert found["in contact with a measured point"] == 0 or "margin 0.0" in case
        assert found["in contact with a point that two frames measured"] == 0 or "margin 0.0" in case


def test_a_scene_without_a_place_to_work_at_is_named(recorded: Path) -> None:
    file = recorded / "scene.yaml"
    Workspace(T_world_base=np.eye(4)).save(file)
    try:
        with pytest.raises(InputError, match=r"scene\.yaml.*workspace"):
            plan_in_run(Results({}), recorded, problems=1, budget_ms=10.0)
    finally:
        file.unlink()


def test_a_base_inside_an_obstacle_is_turned_about_the_centre_until_it_is_free() -> None:
    place = Workspace(T_world_base=np.eye(4), box=np.array([[0.0, -1, 0], [1, 1, 1]]))
    pile = _pile([0.0, 0.0, 0.3])
    found = free_place(pile, place)
    assert found.T_world_base is not None
    assert found.box is not None
    base, middle = found.T_world_base[:3, 3], np.array([WORKSPACE.ahead, 0.0, 0.0])
    np.testing.assert_allclose(np.linalg.norm(base - middle), WORKSPACE.ahead, atol=1e-12)
    np.testing.assert_allclose(found.T_world_base @ [WORKSPACE.ahead, 0, 0, 1], [*middle, 1], atol=1e-12)
    assert np.linalg.norm(base) > 0.2
    assert free_place(_pile([5.0, 5.0, 5.0]), place) is place


def _pile(at: list[float]) -> GaussianCollisionField:
    """Build an obstacle of 20 cm at the shoulder of an arm."""
    points = np.asarray(at) + np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
    return GaussianCollisionField(
        GaussianModel.from_activated(
            means=points,
            quats=np.tile([1.0, 0, 0, 0], (200, 1)),
            scales=np.full((200, 3), 0.02),
            opacities=np.full(200, 0.9),
            colors=np.full((200, 3), 0.5),
        )
    )
