"""`splatbot bench planning` in its quick form."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.planning import BENCHMARK, PlanningSettings
from splatbot.bench.planning.audit import audit
from splatbot.bench.planning.peers import add_ratio
from splatbot.bench.planning_problems import CONSTANTS as PROBLEMS
from splatbot.bench.planning_problems import problems
from splatbot.bench.results import Results
from splatbot.bench.tabletop import tabletop
from splatbot.bench.truth import Truth
from splatbot.cli import main
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.robots.panda import panda


@pytest.fixture(scope="module")
def results(folder: Path) -> Results:
    """One quick run with peers, for all tests."""
    return BENCHMARK.run(PlanningSettings(out=folder, peers=True, quick=True))


def test_every_problem_is_solved_and_no_path_is_in_collision(results: Results) -> None:
    for budget in PlanningSettings.quick_values["budgets"]:
        case = f"budget {budget:g} ms"
        assert results.find(case, "solved") == 6
        for metric in (
            "in contact with the true shapes",
            "in self-collision",
            "true clearance below the certified one",
            "uncertified paths",
        ):
            assert results.find(case, metric) == 0, metric


def test_peers_are_measured_or_reported_as_absent(results: Results) -> None:
    told = {row.peer for row in results.rows if row.peer is not None}
    assert "VAMP" in told
    assert any(name.startswith("OMPL") for name in told)
    assert all(row.value is not None or row.note for row in results.rows)


def test_files_are_written(results: Results, folder: Path) -> None:
    found = json.loads((folder / "planning.json").read_text())
    assert len(found["rows"]) == len(results.rows)
    assert {path.name for path in folder.iterdir()} >= {"planning.csv", "planning-cost.png", "planning-cost.svg"}


def test_problems_are_blocked_on_the_straight_line_and_free_at_both_ends() -> None:
    scene, arm = tabletop(), RobotSpheres(panda())
    field, truth = GaussianCollisionField(scene.gaussians(5000)), Truth(scene, 0.1)
    found = problems(panda(), arm, field, truth, 5, seed=1)
    start, goal = np.array([p.start for p in found]), np.array([p.goal for p in found])
    assert len(found) == 5
    assert arm.certify(field, start, goal).in_collision.all()
    ends = np.concatenate([start, goal])
    assert not arm.check(field, ends).in_collision.any()
    moving = arm.spheres.link > 0
    gap = scene.distance(arm.centers(ends)[:, moving].reshape(-1, 3)).reshape(len(ends), -1) - arm.spheres.radii[moving]
    assert (gap.min(axis=1) > PROBLEMS.min_clearance).all()
    assert (panda().tcp(goal)[:, 2, 3] < 0.22).all()


def test_a_path_through_the_table_is_found_out() -> None:
    scene, arm = tabletop(), RobotSpheres(panda())
    truth = Truth(scene, 0.1)
    down = np.array([0.0, 1.3, 0.0, -0.9, 0.0, 2.2, 0.8])
    rooms, _ = audit([np.stack([panda().home, down])], arm, truth)
    assert rooms[0] < -0.01


def test_ratios_are_paired_over_what_both_solved() -> None:
    results = Results({})
    add_ratio(results, "case", np.array([1.0, 2.0, np.nan, 3.0]), np.array([2.0, 2.0, 1.0, np.nan]), "peer")
    assert results.find("case", "paired ratio of costs, mean", "peer") == pytest.approx(0.75)


def test_the_command_prints_its_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "planning", "--quick", "--out", str(tmp_path), "--json", str(tmp_path / "f.json")]) == 0
    assert "By time budget" in capsys.readouterr().out
    assert (tmp_path / "f.json").exists()
    assert main(["bench", "planning", "--budgets", "0"]) == 2
